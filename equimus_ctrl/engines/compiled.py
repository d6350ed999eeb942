"""Kernels compiled for one robot structure, kept on disk so that the next start takes a fraction of a second.

A kernel module is ordinary Python written against ``engines.model_functions``. For each structure its source is put
behind the functions generated from the symbolic model and compiled by numba, which needs no C compiler.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import os
import sys
import tempfile
from functools import lru_cache
from pathlib import Path
from types import ModuleType

import casadi as ca
import numba
import platformdirs

from equimus_ctrl.models import codegen, morphology, symbolic
from equimus_ctrl.models.morphology import Morphology, Phase, structure
from equimus_ctrl.models.symbolic import Structure

DECORATOR = '@njit(cache=True, nogil=True, error_model="numpy")'
_STUB_IMPORT = "from equimus_ctrl.engines.model_functions import"


def cache_folder() -> Path:
    """Where generated kernels are kept: ``EQUIMUS_CACHE``, else the user's cache folder, else a temporary one."""
    chosen = os.environ.get("EQUIMUS_CACHE")
    folder = Path(chosen) if chosen else Path(platformdirs.user_cache_dir("equimus-ctrl"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        fallback = Path(tempfile.gettempdir()) / f"equimus-ctrl-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
        fallback.mkdir(parents=True, exist_ok=True)
        return fallback


def load(model: Morphology, phase: Phase, kernels: ModuleType) -> ModuleType:
    """The compiled counterpart of a kernel module for a morphology's structure.

    Args:
        model: whose structure; its numbers are arguments of the kernels.
        phase: base fixed or foot pinned.
        kernels: a module written against ``engines.model_functions``.
    """
    return _load(structure(model), phase, kernels)


@lru_cache(maxsize=64)
def _load(form: Structure, phase: Phase, kernels: ModuleType) -> ModuleType:
    sources = [inspect.getsource(m) for m in (symbolic, codegen, morphology, sys.modules[__name__], kernels)]
    sources += [inspect.getsource(m) for m in _imported(kernels)]
    key = hashlib.sha256(repr((form, phase, numba.__version__, sys.version_info[:2], sources)).encode()).hexdigest()
    name = f"equimus_kernel_{key[:20]}"
    path = cache_folder() / f"{name}.py"
    if not path.exists():
        text = _source(form, phase, inspect.getsource(kernels))
        with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".tmp", delete=False, encoding="utf-8") as out:
            out.write(text)
        os.replace(out.name, path)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def _imported(kernels: ModuleType) -> list[ModuleType]:
    """Modules of this package whose compiled functions the kernels use; their text is part of the cache key."""
    used = {getattr(value, "__module__", None) for value in vars(kernels).values()}
    names = sorted(n for n in used if isinstance(n, str) and n.startswith("equimus_ctrl.") and n != kernels.__name__)
    return [sys.modules[n] for n in names]


def _source(form: Structure, phase: Phase, kernels: str) -> str:
    m = symbolic.build(form, phase)
    nj, na = len(form[0]), len(form[1])
    drive = m.jacobian.T @ ca.diag(m.area)
    routines = [
        codegen.Routine("acceleration", {"q": m.q, "v": m.v, "f": m.f, "tau": m.tau}, m.acceleration),
        codegen.Routine("actuator_lengths", {"q": m.q}, m.lengths),
        codegen.Routine("actuator_areas", {}, m.area),
        codegen.Routine("static_pressure", {"q": m.q}, m.static_pressure),
        codegen.Routine("torque_pressure", {"q": m.q, "tau": m.tau}, symbolic.pseudo_solve(drive, m.tau)),
        codegen.Routine("pressure_torque", {"q": m.q, "f": m.f}, drive @ m.f),
    ]
    functions = codegen.generate(routines, m.p, DECORATOR)
    return (
        f"# Generated; safe to delete.\nfrom __future__ import annotations\n\nimport math\n\nimport numpy as np\nfrom numba import njit\n\n"
        f"N_JOINTS = {nj}\nN_ACTUATORS = {na}\n\n\n{functions}\n\n{_tuples(nj, na)}\n\n{_rk4(nj)}\n\n"
        f"{_without_stub_import(kernels)}"
    )


def _without_stub_import(kernels: str) -> str:
    lines = kernels.split("\n")
    kept: list[str] = []
    skipping = False
    for line in lines:
        if line.startswith(_STUB_IMPORT):
            skipping = "(" in line and ")" not in line
        elif skipping:
            skipping = ")" not in line
        elif not line.startswith("from __future__"):
            kept.append(line)
    return "\n".join(kept)


def _tuples(nj: int, na: int) -> str:
    def one(name: str, n: int) -> str:
        entries = ", ".join(f"values[{i}]" for i in range(n))
        return f"{DECORATOR}\ndef {name}(values):\n    return ({entries},)\n"

    return one("joint_tuple", nj) + "\n\n" + one("actuator_tuple", na)


def _rk4(nj: int) -> str:
    def pack(form: str) -> str:
        return "(" + ", ".join(form.format(i=i) for i in range(nj)) + ",)"

    return f"""{DECORATOR}
def rk4(q, v, f, tau, dt, c):
    h = 0.5 * dt
    s = dt / 6.0
    a1 = acceleration(q, v, f, tau, c)
    v2 = {pack("v[{i}] + h * a1[{i}]")}
    a2 = acceleration({pack("q[{i}] + h * v[{i}]")}, v2, f, tau, c)
    v3 = {pack("v[{i}] + h * a2[{i}]")}
    a3 = acceleration({pack("q[{i}] + h * v2[{i}]")}, v3, f, tau, c)
    v4 = {pack("v[{i}] + dt * a3[{i}]")}
    a4 = acceleration({pack("q[{i}] + dt * v3[{i}]")}, v4, f, tau, c)
    return (
        {pack("q[{i}] + s * (v[{i}] + 2.0 * (v2[{i}] + v3[{i}]) + v4[{i}])")},
        {pack("v[{i}] + s * (a1[{i}] + 2.0 * (a2[{i}] + a3[{i}]) + a4[{i}])")},
    )
"""
