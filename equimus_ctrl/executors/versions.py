"""What an answer's bits depend on beside its inputs: versions of the program, of Python and of the libraries."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from equimus_ctrl import __version__

LIBRARIES = ("casadi", "cmaes", "mujoco", "numba", "numpy", "osqp", "scipy")
"""Those that compute."""


@cache
def versions() -> dict[str, str]:
    """Name → version here; the program's with the beginning of the SHA-256 of its source."""
    own, python = f"{__version__} ({_source()[:12]})", ".".join(platform.python_version_tuple()[:2])
    found = {"equimus_ctrl": own, "python": python}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "none"
    return found


def _source() -> str:
    """SHA-256 of all modules of the package."""
    root, found = Path(__file__).resolve().parents[1], hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        if "_presets" not in path.relative_to(root).parts:  # which a checkout does not have
            found.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return found.hexdigest()


def mismatch(other: Mapping[str, str], own: Mapping[str, str] | None = None) -> str | None:
    """The first thing of which there is another version elsewhere, as ``numpy 2.4.6, not 2.4.5``; None of the same."""
    own = versions() if own is None else own
    for name, wanted in own.items():
        if (found := other.get(name, "none")) != wanted:
            return f"{name} {found}, not {wanted}"
    return None
