"""Machine code of lanes, loaded from object files so that the kernels can call it by address."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm  # type: ignore[import-untyped, unused-ignore]

from equimus_ctrl.models.lane_code import target_machine

_loaded: dict[str, Any] = {}
"""Prefix → what holds the code; it lives as long as the process."""
_LOADING = threading.Lock()
"""Code that another thread has handed out must not be replaced."""


def load(path: Path, prefix: str, names: Sequence[str]) -> dict[str, int]:
    """The addresses of functions of an object file, by name; its code lives as long as the process.

    Args:
        path: of the object file.
        prefix: of its symbols.
        names: of its functions, whose symbols are ``prefix_name``.
    """
    with _LOADING:
        if prefix not in _loaded:
            _loaded[prefix] = _engine(path)
        engine = _loaded[prefix]
        return {name: engine.get_function_address(f"{prefix}_{name}") for name in names}


def _engine(path: Path) -> Any:
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target_machine())
    engine.add_object_file(llvm.object_file.ObjectFileRef.from_path(str(path)))
    engine.finalize_object()
    return engine
