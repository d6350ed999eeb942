"""What can be wrong with an input: odd numbers, texts and paths, and changes of files that were right."""

from __future__ import annotations

import re
from random import Random

NUMBERS = (
    "nan", "inf", "-inf", "-1", "0", "-0.0", "0.5", "1e308", "-1e308", "1e400", "1e-320", "1e9", "2147483648", "4294967296",
    "18446744073709551616", "1" + "0" * 400, "0x10", "1_0", "1,5", "1e", "--1", "+1", "", " ", "true", "None", "[]", "٣", "½", "1 2",
)  # fmt: skip
VALUES = (
    "nan", "inf", "-inf", "-1", "0", "0.0", "-0.0", "1", "0.5", "-1e-9", "1e-9", "1e-300", "1e308", "-1e308", "1e10", "1e9", "1000000",
    "100", "1" + "0" * 400, "7" * 5000, "2147483648", "4294967296", "9223372036854775808", "-7", "3.0", "2", "1e5", "40",
)  # fmt: skip
"""Numbers that TOML, XML and CSV can hold."""
KINDS = (
    "true",
    "[]",
    "{}",
    '""',
    '"a"',
    "[1, 2]",
    "[[1]]",
    "{ a = 1 }",
    "1979-05-27",
    "false",
    '"nan"',
    '[""]',
    "[nan, 1]",
)
"""Values of another kind than a number or a text, as TOML has them."""
TEXTS = (
    "", " ", ".", "..", "/", "\\", "é", "日本語", "🦿", "a\u202eb", "e\u0301", "\ufeff", "a\nb", "\t", "\x1b[31m", "x" * 300, "y" * 70_000,
    "-", "--", "%s%n", "{0}", "[bold]", "[/]", "../../etc", "a=b", "=", ":", "a:b:c", "*", "[", "**", "'", '"', "None", "nan", "~",
)  # fmt: skip
PATHS = (
    "", ".", "..", "/", "/dev/null", "/dev/zero", "/dev/full", "/proc/self/status", "/proc/nowhere/x", "pipe", "loop", "folder",
    "empty", "file/below", "nowhere", "nowhere/deep/x", "x" * 300, "deep/" * 900 + "x", "\udcff", "é日本🦿", "a\nb", "~", "*.csv",
    "sealed", "link", "nul\0byte",
)  # fmt: skip
"""``sealed`` may not be written to, ``link`` leads nowhere, ``loop`` to itself; see ``Folder``."""
TOKEN = re.compile(r'-?\d+\.?\d*(?:[eE][-+]?\d+)?|"[^"\n]*"|[\w.]+')


def odd_number(random: Random) -> str:
    return random.choice(NUMBERS)


def odd_text(random: Random) -> str:
    if random.random() < 0.2:
        return "".join(
            chr(random.choice((9, 32, 46, 47, 61, 92, 91, 93, 0x7F, 0xE9, 0x301, 0x202E, 0x1F9BF))) for _ in range(8)
        )
    return random.choice(TEXTS)


def odd_word(random: Random) -> str:
    """Anything that may stand on a command line."""
    return random.choice((odd_number, odd_text, odd_path))(random)


def odd_path(random: Random) -> str:
    return random.choice(PATHS)


def changed(text: str, random: Random, times: int | None = None) -> str:
    """A text file with something else in it, here and there."""
    for _ in range(times or random.choice((1, 1, 1, 2, 4))):
        text = random.choice(CHANGES)(text, random)
    return text


def flipped(data: bytes, random: Random) -> bytes:
    """A binary file cut off, with other bits, or with bytes too many or too few."""
    found = bytearray(data)
    for _ in range(random.choice((1, 1, 3, 20))):
        at = random.randrange(len(found)) if found else 0
        kind = random.randrange(5)
        if kind == 0:
            del found[at:]
        elif kind == 1 and found:
            found[at] ^= 1 << random.randrange(8)
        elif kind == 2:
            found[at : at + 4] = random.choice(
                (b"\xff\xff\xff\xff", b"\x00\x00\x00\x00", b"\xff\xff\xff\x7f", b"\x00\x00\xf0\x7f")
            )
        elif kind == 3:
            del found[at : at + random.choice((1, 8, 1000))]
        else:
            found[at:at] = random.choice((b"\x00", bytes(found[at : at + 500]), b"PK\x03\x04", b"\x89MCAP0\r\n"))
    return bytes(found)


def _number(text: str, random: Random) -> str:
    """Another number in the place of one."""
    found = list(re.finditer(r"(?<![\w.])-?\d+\.?\d*(?:[eE][-+]?\d+)?(?![\w.])", text))
    if not found:
        return _another_token(text, random)
    own = random.choice(found)
    new = random.choice(VALUES) if random.random() < 0.9 else random.choice(KINDS)
    return text[: own.start()] + new + text[own.end() :]


def _value(text: str, random: Random) -> str:
    """Another value after an equals sign, of the same kind or another, or another quoted text."""
    found = list(re.finditer(r'(?<== )[^\n#]+|"[^"\n]*"', text))
    if not found:
        return _number(text, random)
    own = random.choice(found)
    new = (
        random.choice(KINDS)
        if random.random() < 0.5
        else '"' + random.choice(("", " ", "é🦿", "x" * 500, "hip", "hinge", "nan", "..")) + '"'
    )
    return text[: own.start()] + new + text[own.end() :]


def _another_token(text: str, random: Random) -> str:
    found = list(TOKEN.finditer(text))
    if not found:
        return text + odd_text(random)
    own = random.choice(found)
    quoted = own[0].startswith('"')
    new = odd_number(random) if own[0][0] in "-0123456789" and random.random() < 0.8 else odd_text(random)
    return text[: own.start()] + (f'"{new}"' if quoted and random.random() < 0.8 else new) + text[own.end() :]


def _line(text: str, random: Random) -> str:
    """A line twice, none, elsewhere, or one that does not belong there."""
    lines = text.split("\n")
    at, to = random.randrange(len(lines)), random.randrange(len(lines))
    kind = random.randrange(5)
    if kind == 0:
        lines.insert(to, lines[at])
    elif kind == 1:
        del lines[at]
    elif kind == 2:
        lines[at], lines[to] = lines[to], lines[at]
    elif kind == 3:
        lines.insert(
            at,
            random.choice(
                ("# set.nonsense = 1", "[a]", "a = 1", "=", ",,,,", "<x>", "\x00", "[[effects]]", odd_text(random))
            ),
        )
    else:
        lines[at] = lines[at][: random.randrange(len(lines[at]) + 1)]
    return "\n".join(lines)


def _word(text: str, random: Random) -> str:
    """A name misspelt wherever it stands, or in the place of another."""
    words = sorted(set(re.findall(r"[A-Za-z_]{3,}", text)))
    if len(words) < 2:
        return text
    one, other = random.sample(words, 2)
    return text.replace(one, random.choice((one[:-1], one.upper(), other, "")), random.choice((1, -1)))


def _end(text: str, random: Random) -> str:
    return text[: random.randrange(len(text) + 1)]


def _form(text: str, random: Random) -> str:
    """The same in another encoding of lines, with a mark before it, or very deep or long."""
    kind = random.randrange(6)
    if kind == 0:
        return text.replace("\n", "\r\n")
    if kind == 1:
        return "\ufeff" + text
    if kind == 2:
        return text.replace("\n", "\r")
    if kind == 3:
        return text + "\na = " + "[" * 5000 + "]" * 5000
    if kind == 4:
        return text + "\n" + "\n".join(f"k{k} = 1" for k in range(3000))
    return text * 3


CHANGES = (*(_number,) * 12, *(_value,) * 6, *(_another_token,) * 3, *(_line,) * 4, *(_word,) * 3, _end, _form)
