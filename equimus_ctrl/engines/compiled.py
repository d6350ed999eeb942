"""Kernels compiled for one robot structure, kept on disk so that the next start takes a fraction of a second.

A kernel module is ordinary Python written against ``engines.model_functions``. For each structure its source is put
behind the functions generated from the symbolic model and compiled by numba, which needs no C compiler.
"""

from __future__ import annotations

import ast
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
_STUB = "equimus_ctrl.engines.model_functions"


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


def load(model: Morphology, phase: Phase, *kernels: ModuleType) -> ModuleType:
    """The compiled counterpart of kernel modules for a morphology's structure, as one module.

    Args:
        model: whose structure; its numbers are arguments of the kernels.
        phase: base fixed or foot pinned.
        kernels: modules written against ``engines.model_functions``; a later one may import from an earlier one.
    """
    return _load(structure(model), phase, kernels)


@lru_cache(maxsize=64)
def _load(form: Structure, phase: Phase, kernels: tuple[ModuleType, ...]) -> ModuleType:
    sources = [inspect.getsource(m) for m in (symbolic, codegen, morphology, sys.modules[__name__], *kernels)]
    sources += [inspect.getsource(m) for m in _imported(kernels)]
    key = hashlib.sha256(repr((form, phase, numba.__version__, sys.version_info[:2], sources)).encode()).hexdigest()
    name = f"equimus_kernel_{key[:20]}"
    path = cache_folder() / f"{name}.py"
    if not path.exists():
        text = _source(form, phase, kernels)
        with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".tmp", delete=False, encoding="utf-8") as out:
            out.write(text)
        os.replace(out.name, path)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def _imported(kernels: tuple[ModuleType, ...]) -> list[ModuleType]:
    """Modules of this package whose compiled functions the kernels use; their text is part of the cache key."""
    used = {getattr(value, "__module__", None) for kernel in kernels for value in vars(kernel).values()}
    own = {kernel.__name__ for kernel in kernels}
    return [sys.modules[n] for n in sorted(n for n in used if isinstance(n, str) and n.startswith("equimus_ctrl.") and n not in own)]


def _source(form: Structure, phase: Phase, kernels: tuple[ModuleType, ...]) -> str:
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
        f"{_joined(kernels)}"
    )


def _joined(kernels: tuple[ModuleType, ...]) -> str:
    """The kernels' sources one after the other, without what they import from the stub and from each other."""
    provided = {_STUB, "__future__"} | {kernel.__name__ for kernel in kernels}
    text = []
    for kernel in kernels:
        source = inspect.getsource(kernel)
        lines = source.split("\n")
        for node in ast.parse(source).body:
            if isinstance(node, ast.ImportFrom) and node.module in provided:
                assert node.end_lineno is not None
                lines[node.lineno - 1 : node.end_lineno] = [""] * (node.end_lineno - node.lineno + 1)
        text.append("\n".join(lines))
    return "\n\n".join(text)


def _tuples(nj: int, na: int) -> str:
    def one(name: str, n: int) -> str:
        entries = ", ".join(f"values[{i}]" for i in range(n))
        return f"{DECORATOR}\ndef {name}(values):\n    return ({entries},)\n"

    return one("joint_tuple", nj) + "\n\n" + one("actuator_tuple", na)


def _rk4(nj: int) -> str:
    def pack(form: str) -> str:
        return "(" + ", ".join(form.format(i=i) for i in range(nj)) + ",)"

    # One call site in a loop over the stages: less to compile than four, and no slower.
    return f"""{DECORATOR}
def rk4(q, v, f, tau, dt, c):
    qs, vs = q, v
    sum_q, sum_v = {pack("0.0")}, {pack("0.0")}
    for stage in range(4):
        a = acceleration(qs, vs, f, tau, c)
        weight = 1.0 if stage == 0 or stage == 3 else 2.0
        sum_q = {pack("sum_q[{i}] + weight * vs[{i}]")}
        sum_v = {pack("sum_v[{i}] + weight * a[{i}]")}
        h = 0.5 * dt if stage < 2 else dt
        qs = {pack("q[{i}] + h * vs[{i}]")}
        vs = {pack("v[{i}] + h * a[{i}]")}
    s = dt / 6.0
    return {pack("q[{i}] + s * sum_q[{i}]")}, {pack("v[{i}] + s * sum_v[{i}]")}
"""
