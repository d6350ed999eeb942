"""What a user's own Python files add to what is known by name: effects, controllers, plants, scenarios."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from equimus_ctrl import presets
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.errors import ConfigError

NOTHING = (
    "registers nothing; put @register above an effect's class, or call register_controller, register_plant or "
    "register_scenario"
)

_loaded: dict[Path, tuple[tuple[str, ...], ...]] = {}


def known() -> tuple[dict[str, Any], ...]:
    """All that can be added to."""
    # Imported where there is a file to load: a diagnosis needs no controllers.
    from equimus_ctrl.controllers.registry import CONTROLLERS
    from equimus_ctrl.plants.registry import PLANTS
    from equimus_ctrl.scenarios.registry import SCENARIOS

    return REGISTRY, CONTROLLERS, PLANTS, SCENARIOS


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
        registries = known()
        before = [dict(registry) for registry in registries]
        for registry, old in zip(registries, _loaded.get(path.resolve(), ()), strict=False):
            for name in old:
                registry.pop(name, None)
        others = [set(registry) for registry in registries]
        try:
            presets.load_script(path, sent=False)
            pairs = zip(registries, others, strict=True)
            own = tuple(tuple(name for name in registry if name not in other) for registry, other in pairs)
            if not any(own):
                raise ConfigError(f"{path}: {NOTHING}")
        except BaseException:
            for registry, held in zip(registries, before, strict=True):
                registry.clear()
                registry.update(held)
            raise
        _loaded[path.resolve()] = own
        names += [name for kind in own for name in kind]
    return tuple(dict.fromkeys(names))


def loaded() -> list[Path]:
    """The files that are loaded, for another process to load too."""
    return list(_loaded)


def plugins_digest(files: Iterable[Path | str]) -> str | None:
    """SHA-256 of what files hold, in their order; None of no files."""
    texts = [presets.read_bytes(Path(file)) for file in files]
    return hashlib.sha256(b"\0".join(texts)).hexdigest() if texts else None
