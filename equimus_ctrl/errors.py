"""Every exception this package raises on purpose.

An exception that reaches a user is one sentence: what is wrong, where, the value found, and what would have
been right.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from typing import Any

MOST_SAID, LONGEST_WORD, MOST_LISTED = 1000, 200, 400
"""Characters of a message, of what stands in it without a space (a number, a name, a path), and of a list of names."""


class EquimusError(Exception):
    """Root of all errors raised on purpose by this package."""


class ConfigError(EquimusError):
    """A setting is missing, unknown, of the wrong type or outside its bounds."""


class ModelError(EquimusError):
    """A morphology or model cannot be simulated as described."""


class RecordingError(EquimusError):
    """A recording cannot be read, or what it holds cannot be right."""


class SimulationDiverged(EquimusError):
    """A simulation left the range where its values mean anything.

    Attributes:
        run: what happened before, a ``types.Run``, where it was driven by ``loop.run``; else None.
        scenario: name of what was done, where that has one.
        controller: name of what drove it, likewise.
        recording: file that it was recorded into, if that was asked for.
    """

    run: Any = None
    scenario: str = ""
    controller: str = ""
    recording: Any = None


class NothingFeasible(EquimusError):
    """Nothing within the limits was found."""


class HardwareFault(EquimusError):
    """A robot was vented because something was not as it must be."""


FAILURES = (Exception, SystemExit)
"""What a user's code may fail with: ``sys.exit`` as well, or a run would end as if all were well."""


class ControllerError(EquimusError):
    """A controller could not be loaded, or returned something that is not a command."""


class NotAvailable(EquimusError):
    """Something optional (a recording, a renderer, an extra package) is not there."""


def one_line(text: str) -> str:
    """A sentence as one line of what can be printed, its middle left out where it is longer than anybody reads.

    What a message quotes may be anybody's: several lines of another program's words, or a value of megabytes.
    """
    text = re.sub(rf"\S{{{LONGEST_WORD + 1},}}", lambda word: _cut(word[0], LONGEST_WORD), text)
    line = re.sub(r"\s*[\n\r\t]\s*", " ", _cut(text, MOST_SAID).strip())
    return "".join(ch if ch.isprintable() else ch.encode("unicode_escape").decode() for ch in line)


def _cut(text: str, most: int) -> str:
    """A text without its middle where it is longer than so many characters."""
    half = most // 2
    return text if len(text) <= most else f"{text[:half]} … ({len(text) - 2 * half} characters) … {text[-half:]}"


def nearest(name: str, known: Iterable[str]) -> str:
    """The known name most like ``name``, as ``; did you mean 'x'?``, or an empty string."""
    match = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean {match[0]!r}?" if match else ""


def unknown_name(kind: str, name: str, known: Iterable[str], where: str = "") -> str:
    """One sentence for a name that does not exist, listing those that do."""
    names = sorted(known)
    place = f"{where}: " if where else ""
    listed = ", ".join(names) or "none"
    if len(listed) > MOST_LISTED:
        listed = listed[: listed.rindex(", ", 0, MOST_LISTED)]
        listed += f" and {len(names) - listed.count(', ') - 1} more"
    return f"{place}there is no {kind} {name!r}{nearest(name, names)} (known: {listed})"


def needs(package: str, extra: str, what: str) -> NotAvailable:
    """The error where a library is not installed."""
    return NotAvailable(
        f"{what} needs the {package} library, which is not installed; get it with: pip install 'equimus-ctrl[{extra}]'"
    )
