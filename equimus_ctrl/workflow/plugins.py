"""What a user's own Python files add to what is known by name: effects, controllers, plants, scenarios."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from equimus_ctrl import presets
from equimus_ctrl.controllers.registry import CONTROLLERS
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.plants.registry import PLANTS
from equimus_ctrl.scenarios.registry import SCENARIOS

KNOWN: tuple[dict[str, Any], ...] = (REGISTRY, CONTROLLERS, PLANTS, SCENARIOS)
"""All that can be added to."""
NOTHING = (
    "registers nothing; put @register above an effect's class, or call register_controller, register_plant or "
    "register_scenario"
)

_loaded: dict[Path, tuple[tuple[str, ...], ...]] = {}


def load_plugins(files: Iterable[Path | str]) -> tuple[str, ...]:
    """Run Python files that register effects, controllers, plants or scenarios.

    A file loaded before replaces what it registered then.

    Returns:
        The names registered.

    Raises:
        ConfigError: where a file is not there, fails, registers nothing, or registers a name that is taken; what was
            registered then stays as it was before.
    """
    names: list[str] = []
    for file in files:
        path = Path(file)
        before = [dict(known) for known in KNOWN]
        for known, old in zip(KNOWN, _loaded.get(path.resolve(), ()), strict=False):
            for name in old:
                known.pop(name, None)
        others = [set(known) for known in KNOWN]
        try:
            presets.load_script(path)
            own = tuple(tuple(name for name in known if name not in o) for known, o in zip(KNOWN, others, strict=True))
            if not any(own):
                raise ConfigError(f"{path}: {NOTHING}")
        except BaseException:
            for known, held in zip(KNOWN, before, strict=True):
                known.clear()
                known.update(held)
            raise
        _loaded[path.resolve()] = own
        names += [name for kind in own for name in kind]
    return tuple(dict.fromkeys(names))


def plugins_digest(files: Iterable[Path | str]) -> str | None:
    """SHA-256 of what files hold, in their order; None of no files."""
    texts = [presets.read_bytes(Path(file)) for file in files]
    return hashlib.sha256(b"\0".join(texts)).hexdigest() if texts else None
