"""Files of a proof that are read back: what a folder is for, and answers."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from equimus_ctrl import presets
from equimus_ctrl.errors import ConfigError, EquimusError
from equimus_ctrl.executors.calls import Ended
from equimus_ctrl.proof.store import Request
from equimus_ctrl.recordings.folders import read_text
from equimus_ctrl.workflow.plugins import plugins_digest

HASHED = {"recordings_sha256": "other recordings", "model_sha256": "another model"}
"""Of what the request holds hashes, and what it says where they differ."""
UNSAID: Mapping[str, Any] = {"track_hz": None, "excitation": "rich"}
"""What a request that does not say it was made with."""


def wanted_of(request: Request, plugins: Sequence[Path]) -> dict[str, Any]:
    """What a folder's proof has to be of."""
    wanted: dict[str, Any] = {
        "seed": request.seed,
        "kind": request.kind,
        "trials": request.trials,
        "duration_s": request.duration,
        "physics_hz": request.rate,
        "robot": request.model.name,
    }
    wanted |= request.source.made_of()
    digest = plugins_digest(plugins)
    return wanted | ({} if digest is None else {"plugins_sha256": digest})


def claimed(folder: Path) -> dict[str, Any]:
    """What another folder's proof is of.

    Raises:
        ConfigError: where it holds none.
    """
    if (text := read_text(folder / "request.json")) is None:
        raise ConfigError(f"{folder}: holds no proof (there is no request.json)")
    return parsed(text)


def claim(folder: Path, wanted: Mapping[str, Any]) -> None:
    """Note in the folder what it is for, or raise ConfigError where it is for something else."""
    text = read_text(folder / "request.json")
    if text is None:
        presets.write_text(folder / "request.json", presets.json_text(wanted))
    else:
        check_claim(folder, wanted, parsed(text))


def check_claim(folder: Path, wanted: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    """Raise ConfigError where a folder is for something else."""
    if found.get("plugins_sha256") != wanted.get("plugins_sha256"):
        raise ConfigError(f"{folder}: holds a proof with other plugins; choose another folder")
    for key, value in wanted.items():
        if (known := found.get(key, UNSAID.get(key, value))) != value:
            if key in HASHED:
                raise ConfigError(f"{folder}: holds a proof with {HASHED[key]}; choose another folder")
            raise ConfigError(f"{folder}: holds a proof with {key} {known}, not {value}; choose another folder")


def require_all(ended: Mapping[str, Ended], did: str) -> None:
    """Raise EquimusError where processes ended without an answer.

    Args:
        ended: what for → how.
        did: what they were doing.
    """
    if ended:
        name, how = min(ended.items())
        more = f" and {len(ended) - 1} more" if len(ended) > 1 else ""
        raise EquimusError(
            f"the process that {did} {name}{more} {how} before it had an answer; run it again, with fewer workers "
            "where memory is short"
        )


def read_answer(path: Path) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        ConfigError: where there is none.
    """
    text = read_text(path)
    found = parsed(text or "")
    if not found:
        raise ConfigError(f"{path}: is no answer of a proof; remove it and run again")
    return found


def parsed(text: str) -> dict[str, Any]:
    """The JSON object in a text; empty where it is none."""
    try:
        found = json.loads(text)
    except json.JSONDecodeError:
        return {}
    return dict(found) if isinstance(found, Mapping) else {}
