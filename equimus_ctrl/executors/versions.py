"""What an answer's bits depend on beside its inputs: versions of program, Python and libraries, and the processor."""

from __future__ import annotations

import hashlib
import platform
import warnings
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


class OtherProcessor(UserWarning):
    """Work is done on processors of more than one kind: its last bits may depend on which did what."""


@cache
def processor() -> dict[str, str]:
    """What linear algebra and compiled equations are made for here: BLAS with its kernels, and numba's processor.

    Sums in another order, or with fused multiplication, differ in the last bits; the same versions do not change that.
    """
    import numpy.linalg  # noqa: F401 – with it BLAS is there to be asked
    from threadpoolctl import threadpool_info

    blas = {
        f"{own['internal_api']} {own.get('architecture', '')}".strip()
        for own in threadpool_info()
        if own["user_api"] == "blas" and Path(own["filepath"]).parent.name.startswith("numpy")
    }
    return {"blas": ", ".join(sorted(blas)) or "unknown", "numba": _numbas()}


def _numbas() -> str:
    try:
        from llvmlite.binding import get_host_cpu_name
        from numba.core import config
    except ImportError:
        return "none"
    return str(getattr(config, "CPU_NAME", None) or get_host_cpu_name())


def warn_of_mix(others: Mapping[str, Mapping[str, str]], own: Mapping[str, str] | None = None) -> bool:
    """Warn where another processor than here does some of the work, and tell whether it does.

    Args:
        others: who → its ``processor()``.
        own: what they are compared with; this computer's by default.
    """
    own = processor() if own is None else own
    for who, found in others.items():
        if (other := mismatch(found, own)) is not None:
            warnings.warn(
                f"{who} has another processor ({other}): the last bits of what it computes may differ", OtherProcessor,
                stacklevel=2,
            )  # fmt: skip
            return True
    return False


def mismatch(other: Mapping[str, str], own: Mapping[str, str] | None = None) -> str | None:
    """The first thing of which there is another version elsewhere, as ``numpy 2.4.6, not 2.4.5``; None of the same."""
    own = versions() if own is None else own
    for name, wanted in own.items():
        if (found := other.get(name, "none")) != wanted:
            return f"{name} {found}, not {wanted}"
    return None
