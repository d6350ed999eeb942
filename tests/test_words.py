"""The field's words: no private phrase of the list below stands in pages, messages, help, docstrings or comments.

``docs/glossary.md`` has the terms that stand in their place.
"""

from __future__ import annotations

import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PRIVATE = {
    r"as it came\b": "initial (nominal) model",
    r"own numbers": "parameters",
    r"what may be wrong about": "parameters to estimate",
    r"\bleaves? out of\b|left out of the model|trials? (?:that (?:is|are|were) )?left out": "missing; held-out",
    r"\bbelieve[ds]?\b|borne out": "accepted; confirmed on held-out data",
    r"\bchance 10": "p-value",
    r"\bexcess (?:error|of [\d.])|takes? away \d|error taken away": "excess residual variance; explains",
    r"off by [\d.]+ times the noise": "normalised RMSE",
    r"(?:push(?:es)?|forces?|residuals?) without a name|\bleftovers?\b": "generalised force; unstructured residual force; residual",
    r"name is withdrawn|\bshadow|does the same as": "rejected as confounded; confounded; not distinguishable",
    r"told apart\b": "distinguishable; identifiable",
    r"\bconceal|\bunseal|\brealit(?:y|ies)\b|nothing left out|opening the seals": "blinded synthetic ground truth; negatives",
    r"what these cannot do": "orthogonal component",
    r"\bvalleys?\b|\bacts? in steps|looked around": "local minima; discontinuous parameters; grid scan",
    r"neighbouring residuals are alike|are worth about": "autocorrelated residuals; effective sample size",
    r"\bshooting windows?\b|\bto shoot\b": "shooting interval; multiple shooting",
    r"have no step\b|\bstep's error": "discretisation error",
    r"late, slow valves?|unknown_late|late/back": "dead time, lag; unmodelled delay; deadline overruns",
    r"without a bump|\ballowances?\b|\bholds back\b": "bumpless transfer; maximum acceptable deviations; saturates",
    r"commands? (?:are |is )?at a limit": "saturation",
    r"\bmoving up\b": "q̇ > 0",
    r"\b(?:of|from) MuJoCo's XML|MuJoCo's XML's": "MJCF robot",
    r"\bcutoffs?\b(?! (?:frequency|of \d))": "threshold with jump",
    r"narrowing area": "length-dependent effective area",
    r"sizes over the middle": "normalised by the median",
    r"\bstrays?\b": "standard deviation",
}
"""Private phrase → what to say."""
PAGES = ("README.md", "CONTRIBUTING.md", "SECURITY.md", "RELEASING.md", "docs/**/*.md", ".github/**/*.md")
CODE = ("equimus_ctrl/**/*.py", "docs/**/*.py", "website/*.py", "scenarios/*.py", "controllers/*.py")
ELSEWHERE = {
    "docs/glossary.md": "it explains the terms, some by everyday words",
    "docs/proof/": "records of proofs as versions of their time wrote them; their seals are of these bytes",
    "docs/evidence/": "what earlier versions said, in their words",
}
"""Pages that are not looked at, and why."""
EXCEPTIONS = {
    ("equimus_ctrl/cli/score.py", "conceal"): "a folder of recordings that others made has this name",
    ("equimus_ctrl/proof/designs.py", "conceal"): "the same folder",
}
"""(file, phrase as it stands there) → why it may."""


def pages() -> Iterator[tuple[str, int, str]]:
    """Name, line and text of every line of prose; code in it is not looked at."""
    for pattern in PAGES:
        for path in sorted(ROOT.glob(pattern)):
            name = path.relative_to(ROOT).as_posix()
            if name.startswith(tuple(ELSEWHERE)):
                continue
            text = re.sub(r"(?ms)^ *```.*?^ *```", lambda m: "\n" * m[0].count("\n"), path.read_text(encoding="utf-8"))
            text = re.sub(r"`[^`\n]*`|\]\([^)\s]*\)", " ", text)
            yield from _lines(name, text, 1)


def strings() -> Iterator[tuple[str, int, str]]:
    """Name, line and text of every string and comment of the code: messages, help, docstrings, labels of figures."""
    for pattern in CODE:
        for path in sorted(ROOT.glob(pattern)):
            name = path.relative_to(ROOT).as_posix()
            for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
                kind = tokenize.tok_name[token.type]
                if kind in ("STRING", "COMMENT", "FSTRING_MIDDLE") and _is_text(token.string):
                    yield from _lines(name, re.sub(r"``[^`\n]*``|`[^`\n]*`", " ", token.string), token.start[0])


def _is_text(string: str) -> bool:
    """Whether somebody reads it: a word by itself is a name or a key."""
    return " " in string.strip("\"'#rf ")


def _lines(name: str, text: str, first: int) -> Iterator[tuple[str, int, str]]:
    """Lines, each with the next one's first words, for phrases that go on there."""
    lines = text.splitlines()
    for number, line in enumerate(lines):
        following = " ".join((lines[number + 1] if number + 1 < len(lines) else "").lstrip("#-* ").split()[:4])
        yield name, first + number, f"{line.rstrip()}\n{following}"


def found(texts: Iterator[tuple[str, int, str]]) -> list[str]:
    """Sentences on every private phrase that begins in a line and is no exception."""
    told = []
    for name, line, text in texts:
        end = text.index("\n")
        for pattern, better in PRIVATE.items():
            spaced = re.compile(pattern.replace(" ", r"\s+"), re.IGNORECASE)
            for match in spaced.finditer(text):
                if match.start() < end and (name, match[0].lower()) not in EXCEPTIONS:
                    told.append(f"{name}:{line}: {' '.join(match[0].split())!r}, say: {better}")
    return told


def test_no_page_has_a_private_phrase() -> None:
    assert found(pages()) == []


def test_no_message_help_or_docstring_has_a_private_phrase() -> None:
    assert found(strings()) == []


@pytest.mark.parametrize(
    "said", ["a shadow of it", "They cannot be told\napart.", "The name is withdrawn", "an excess of 0.3", "a cutoff"]
)
def test_private_phrases_are_found_across_lines(said: str) -> None:
    assert found(_lines("a page", said, 1))


def test_every_exception_and_every_page_elsewhere_is_still_there() -> None:
    for name, phrase in EXCEPTIONS:
        assert phrase in " ".join((ROOT / name).read_text(encoding="utf-8").lower().split()), (name, phrase)
    for name in ELSEWHERE:
        assert (ROOT / name).exists(), name
