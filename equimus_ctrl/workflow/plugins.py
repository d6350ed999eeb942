"""Effects that a user's own Python files add to the catalogue."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from equimus_ctrl import presets
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.errors import ConfigError

_loaded: dict[Path, tuple[str, ...]] = {}


def load_effects(files: Iterable[Path | str]) -> tuple[str, ...]:
    """Run Python files that register effects; a file loaded before replaces what it registered then.

    Returns:
        The names registered.

    Raises:
        ConfigError: where a file is not there, fails, registers nothing, or registers a name that is taken; what was
            registered then stays as it was before.
    """
    names: list[str] = []
    for file in files:
        path = Path(file)
        before = dict(REGISTRY)
        for name in _loaded.get(path.resolve(), ()):
            REGISTRY.pop(name, None)
        others = set(REGISTRY)
        try:
            presets.load_script(path)
            own = tuple(name for name in REGISTRY if name not in others)
            if not own:
                raise ConfigError(f"{path}: registers no effect; put @register above its class")
        except BaseException:
            REGISTRY.clear()
            REGISTRY.update(before)
            raise
        _loaded[path.resolve()] = own
        names += own
    return tuple(dict.fromkeys(names))
