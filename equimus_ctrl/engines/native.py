"""CasADi functions as machine code where the computer has a C compiler; elsewhere CasADi's interpreter evaluates them.

The library is made once and kept in the cache of kernels. Products and sums are not contracted, so that both ways give
the same numbers.
"""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path

import casadi as ca

from equimus_ctrl.engines.compiled import cache_folder

FLAGS = ("-O2", "-fPIC", "-shared", "-ffp-contract=off")
LOG = logging.getLogger(__name__)
LONGEST = 300.0
"""A compiler that takes longer is given up [s]."""


def compiler() -> str | None:
    """The C compiler: what ``CC`` names, else cc, gcc or clang; None where there is none or ``CC`` is empty."""
    if "CC" in os.environ:
        return shutil.which(os.environ["CC"]) if os.environ["CC"] else None
    return next((found for name in ("cc", "gcc", "clang") if (found := shutil.which(name))), None)


def native(function: ca.Function, name: str) -> ca.Function | None:
    """A function as machine code, compiled the first time that it is asked for.

    Args:
        function: of scalar operations.
        name: of the library in the cache.

    Returns:
        The same function, or None where there is no compiler or it fails.
    """
    with_compiler = compiler()
    if with_compiler is None or os.name != "posix":
        return None
    generator = ca.CodeGenerator("native.c")
    generator.add(function)
    return _library(generator.dump(), function.name(), name, with_compiler, cache_folder())


@lru_cache(maxsize=32)
def _library(text: str, entry: str, name: str, with_compiler: str, folder: Path) -> ca.Function | None:
    # The computer is part of the key: a cache may be shared.
    key = hashlib.sha256(repr((text, FLAGS, with_compiler, platform.machine(), platform.system())).encode()).hexdigest()
    path = folder / f"equimus_{name}_{key[:20]}.so"
    if not path.exists():
        LOG.info("compiling %s, %.1f MB of C, once for a robot like this …", entry, len(text) / 1e6)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            source, made = Path(scratch) / "native.c", Path(scratch) / "native.so"
            source.write_text(text, encoding="utf-8")
            try:
                command = [with_compiler, *FLAGS, str(source), "-o", str(made), "-lm"]
                done = subprocess.run(command, capture_output=True, timeout=LONGEST, check=False)
            except (OSError, subprocess.TimeoutExpired):
                return None
            if done.returncode != 0:
                return None
            os.replace(made, path)
    try:
        return ca.external(entry, str(path))
    except RuntimeError:
        return None
