"""Records of proofs as pages of the site: the files stay as they were written, with their time's words and tables."""

from __future__ import annotations

import posixpath
import re

from equimus_ctrl.report.proof_tables import numbers

RECORD = re.compile(r"proof/.+/score\.md")
TODAY = "Blinded ground truths"
"""How records begin that are written in the words of today."""
MEANT = (
    "[What the words mean]({up}glossary.md#proof); "
    "[how ground truths are made, and what diagnoses came to]({up}proof.md)."
)
OLDER = "This is a record, in the words of its time; [what they mean]({up}glossary.md#words-of-older-records). "
HEAD = re.compile(r"(?m)^- (robot|seed|cases): ([^,\n]+)(?:, all of kind (\w+))?")
TABLE = re.compile(r"(?m)^\|.*\|\n\|(?: *:?-+:? *\|)+\n(?:\|.*\|(?:\n|\Z))*")
BAR = re.compile(r"(?<!\\)\|")
JOINED = re.compile(r"(?<=\w[:+])(?=\w)")
"""Where a line may end in an effect with its places."""
SMALL = re.compile(r"\b(\d[\d.]*)e([-+]\d+)\b")


def is_record(uri: str) -> bool:
    """Whether a page is one."""
    return RECORD.fullmatch(uri) is not None


def record(uri: str, markdown: str) -> str:
    """The page of a record: its own title, what its words mean, and tables whose words stand to the left."""
    title, _, rest = markdown.partition("\n")
    title = title.removeprefix("# ")
    up = posixpath.relpath(".", posixpath.dirname(uri)) + "/"
    note = ("" if title == TODAY else OLDER) + MEANT
    parts = [f"# {titled(uri, title, rest)}", note.format(up=up), TABLE.sub(lambda found: _table(found[0]), rest)]
    return "\n\n".join(parts)


def titled(uri: str, title: str, rest: str) -> str:
    """A title that no other record has: the robot, of what kind all cases are, and the seed of the draw."""
    found = {name: (value, kind) for name, value, kind in HEAD.findall(rest)}
    if not {"seed", "cases"} <= found.keys():
        return title  # no draw of its own
    robot = found.get("robot", ("EquiMus legs", ""))[0]
    kind = {"": "", "none": ", nothing missing"}.get(found["cases"][1], f", all of kind {found['cases'][1]}")
    return f"{title}: {robot}{kind}, seed {found['seed'][0]}"


def _table(text: str) -> str:
    head, _, *rows = ([cell.strip() for cell in BAR.split(line)[1:-1]] for line in text.splitlines())
    rule = ["---:" if number else "---" for number in numbers(len(head), rows)]
    shown = [[_cell(cell) for cell in row] for row in rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in (head, rule, *shown))


def _cell(text: str) -> str:
    power = SMALL.sub(lambda found: f"{found[1]}·10<sup>{int(found[2])}</sup>".replace("-", "−"), text)
    return JOINED.sub("<wbr>", power)
