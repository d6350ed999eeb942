"""Truths as lines of text, and the seals that show that none was changed after the fact."""

from __future__ import annotations

import hashlib
import hmac
import json
from collections.abc import Mapping, Sequence
from typing import Any

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.types import Recording


def canonical(truth: Mapping[str, Any]) -> str:
    """The one line of JSON of a truth: keys sorted, no blanks, numbers as short as they read back the same.

    Raises:
        ConfigError: where it holds what JSON does not, such as a number that is not finite.
    """
    try:
        return json.dumps(truth, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"this truth cannot be sealed: {error}") from None


def salt(seed: int, case: int) -> str:
    """What keeps a short truth from being guessed from its seal; it follows from the seed, so that a proof repeats."""
    return hashlib.sha256(f"equimus-ctrl/proof/salt/{seed}/{case}".encode()).hexdigest()[:32]


def salted(truth: Mapping[str, Any], seed: int, case: int) -> str:
    """The line that is sealed: ``canonical`` with the salt in it."""
    return canonical({**truth, "salt": salt(seed, case)})


def seal(line: str) -> str:
    """SHA-256 of a line."""
    return hashlib.sha256(line.encode()).hexdigest()


def seal_of_all(seals: Sequence[str]) -> str:
    """SHA-256 over seals in order, a line each: what ``cat seals/*.txt | sha256sum`` gives."""
    return hashlib.sha256("".join(f"{one}\n" for one in seals).encode()).hexdigest()


def digest(recordings: Sequence[Recording]) -> str:
    """SHA-256 of what recordings say, which binds them to the truth that holds it."""
    found = hashlib.sha256()
    for recording in recordings:
        found.update(canonical({"name": recording.name, "columns": [*recording.actuators, *recording.joints]}).encode())
        for array in (recording.time, recording.command, recording.position, recording.command_before):
            found.update(array.astype("<f8").tobytes())
    return found.hexdigest()


def opened(line: str, sealed: str, where: str = "truth") -> dict[str, Any]:
    """The truth in a line.

    Raises:
        ConfigError: where the seal is not the line's, or the line is no truth.
    """
    if not hmac.compare_digest(seal(line), sealed):
        raise ConfigError(f"{where}: its seal is {seal(line)}, expected {sealed}; it was changed after it was sealed")
    truth = json.loads(line)
    if not isinstance(truth, dict):
        raise ConfigError(f"{where}: the line holds no truth, expected a JSON object")
    return truth
