"""By what an answer was made: the source of all that a diagnosis is made of, and its settings."""

from __future__ import annotations

import hashlib
import importlib.util
import pkgutil
from collections.abc import Iterator, Sequence

PARTS = ("diagnosis", "effects", "engines", "identification", "models", "robots")
"""Parts of the package that decide what a diagnosis says."""
BASELINES = ("proof.baselines", "proof.refits", "proof.sindy_baseline", "proof.torques")
"""What the baselines add to that."""


def fingerprint(settings: str = "", parts: Sequence[str] = PARTS) -> str:
    """SHA-256 of the source of some parts of the package, and of settings as text."""
    found = hashlib.sha256(settings.encode())
    for part in parts:
        for name, source in _sources(f"equimus_ctrl.{part}"):
            found.update(f"\n{name}\n{source}".encode())
    return found.hexdigest()


def _sources(name: str) -> Iterator[tuple[str, str]]:
    """(name, source) of a module and of all below it, by name; none of it is run that is not loaded anyway."""
    spec = importlib.util.find_spec(name)
    if spec is None:
        raise ModuleNotFoundError(name)
    yield name, _source(spec.loader, name)
    for info in sorted(pkgutil.iter_modules(spec.submodule_search_locations or []), key=lambda info: info.name):
        yield from _sources(f"{name}.{info.name}")


def _source(loader: object, name: str) -> str:
    return str(loader.get_source(name)) if hasattr(loader, "get_source") else ""
