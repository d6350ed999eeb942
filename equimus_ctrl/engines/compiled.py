"""Compiled kernels, kept on disk so that the next start takes a fraction of a second.

The lane kernels are the same for every robot and compiled once on a computer; each structure brings the machine code of
its own functions (``load_lanes``). Other kernel modules are ordinary Python written against
``engines.model_functions``: for each structure their source is put behind the functions generated from the symbolic
model. All is compiled by numba and LLVM, which need no C compiler.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import inspect
import os
import stat
import sys
import tempfile
import threading
from functools import lru_cache
from pathlib import Path
from types import ModuleType

import casadi as ca
import numba
import platformdirs

from equimus_ctrl.engines import (
    lane_begin,
    lane_dry_friction,
    lane_functions,
    lane_hidden,
    lane_kernel,
    lane_steps,
    mjcf_functions,
    mjcf_kernel,
    mjcf_tracked_kernel,
)
from equimus_ctrl.models import (
    codegen,
    elastic_equations,
    parts,
    symbolic,
    symbolic_model,
    tree,
)
from equimus_ctrl.models.augmented import Laws, state_change
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, pack, structure
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.types import Array

DECORATOR = '@njit(cache=True, nogil=True, error_model="numpy")'
_STUB = "equimus_ctrl.engines.model_functions"
LANE_KERNELS = (lane_functions, lane_begin, lane_steps, lane_dry_friction, lane_hidden, lane_kernel)
"""Modules written against ``engines.lane_functions``, each of which may import from those before it."""


def cache_folder() -> Path:
    """Where generated kernels are kept: ``EQUIMUS_CACHE``, else the user's cache folder, else a temporary one."""
    chosen = os.environ.get("EQUIMUS_CACHE")
    folder = Path(chosen) if chosen else Path(platformdirs.user_cache_dir("equimus-ctrl"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return _private_folder()


@lru_cache(maxsize=1)
def _private_folder() -> Path:
    """A folder among the temporary ones that belongs to this user alone, for code is loaded from it."""
    user = os.getuid() if hasattr(os, "getuid") else None
    folder = Path(tempfile.gettempdir()) / f"equimus-ctrl-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        if user is None or (status.st_uid == user and stat.S_ISDIR(status.st_mode) and not status.st_mode & 0o022):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="equimus-ctrl-"))


def load(model: Morphology, phase: Phase, kernel: ModuleType) -> ModuleType:
    """The compiled counterpart of a kernel module for a morphology's structure.

    Args:
        model: whose structure; its parameters are arguments of the kernels.
        phase: base fixed or foot pinned.
        kernel: a module written against ``engines.model_functions``; it may import from other such modules, and from
            the lane kernels (``LANE_KERNELS``).
    """
    return _load(structure(model), phase, kernel)


@lru_cache(maxsize=8)
def load_mjcf(laws: Laws) -> tuple[ModuleType, ModuleType]:
    """What is generated for laws at joints of MJCF robots, and the kernel (``engines.mjcf_kernel``) with it."""
    generated = _generated("mjcf_laws", _mjcf_source(laws), [])
    return generated, _led(mjcf_kernel, {mjcf_functions.__name__: generated})


@lru_cache(maxsize=8)
def load_mjcf_tracked(laws: Laws) -> ModuleType:
    """The same of closed loops (``engines.mjcf_tracked_kernel``)."""
    _, kernel = load_mjcf(laws)
    return _led(mjcf_tracked_kernel, {mjcf_kernel.__name__: kernel})


def prepared(model: Morphology, phase: Phase) -> Array:
    """The constants that every compiled function of a morphology takes as its last argument."""
    constants: Array = _model(structure(model), phase).prepare(pack(model))
    return constants


def mark_compiled(kernel: ModuleType) -> None:
    """Leave a mark in the cache that a loaded kernel's functions have been compiled."""
    (cache_folder() / f"{kernel.__name__}.compiled").touch()


def is_marked_compiled(kernel: ModuleType) -> bool:
    """Whether ``mark_compiled`` was called for a kernel on this computer."""
    return (cache_folder() / f"{kernel.__name__}.compiled").exists()


@lru_cache(maxsize=1)
def lane_modules() -> dict[str, ModuleType]:
    """The lane kernels as they are compiled, by the names of their sources."""
    made: dict[str, ModuleType] = {}
    for module in LANE_KERNELS:
        made[module.__name__] = _led(module, made)
    return made


@lru_cache(maxsize=64)
def _load(form: Structure, phase: Phase, kernel: ModuleType) -> ModuleType:
    replaced = {_STUB: _model(form, phase)}
    if lane_functions.__name__ in inspect.getsource(kernel):
        replaced |= lane_modules()
    for other in _imported(kernel):
        if _STUB in inspect.getsource(other):
            replaced[other.__name__] = _load(form, phase, other)
    return _led(kernel, replaced)


def _led(kernel: ModuleType, replaced: dict[str, ModuleType]) -> ModuleType:
    """The kernel's source with its imports of a stub and of other kernels led to their generated counterparts."""
    source = inspect.getsource(kernel)
    lines = source.split("\n")
    for node in ast.parse(source).body:
        if isinstance(node, ast.ImportFrom) and node.module in replaced:
            lines[node.lineno - 1] = lines[node.lineno - 1].replace(node.module, replaced[node.module].__name__)
    helpers = [inspect.getsource(m) for m in _imported(kernel) if m.__name__ not in replaced]
    return _generated(kernel.__name__.rpartition(".")[2], "\n".join(lines), helpers)


@lru_cache(maxsize=64)
def _model(form: Structure, phase: Phase) -> ModuleType:
    """The functions of ``engines.model_functions`` for one structure."""
    modules = (elastic_equations, symbolic, symbolic_model, parts, tree, codegen, sys.modules[__name__])
    sources = [inspect.getsource(m) for m in modules]
    key = digest([repr((form, phase)), *sources])
    path = cache_folder() / f"equimus_model_{key}.py"
    text = kept(path) if path.exists() else _source(form, phase)
    return _written(path, text)


def _generated(label: str, text: str, depends: list[str]) -> ModuleType:
    return _written(cache_folder() / f"equimus_{label}_{digest([text, *depends])}.py", text)


def digest(parts: list[str]) -> str:
    """Twenty digits that tell sources apart, and versions of Python and numba."""
    text = repr((numba.__version__, sys.version_info[:2], parts))
    return hashlib.sha256(text.encode()).hexdigest()[:20]


_WRITING = threading.RLock()
"""A module that another thread imports is not found half made; importing one may write others."""


def _written(path: Path, text: str) -> ModuleType:
    """Put a module into the cache folder, whole or not at all, and import it."""
    with _WRITING:
        known = sys.modules.get(path.stem)
        if known is not None and known.__file__ == str(path) and path.exists():
            return known
        if not path.exists():
            put(path, text.encode())
        return _imported_from(path)


def _imported_from(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[path.stem]
        raise
    return module


def kept(path: Path) -> str:
    """Text that ``put`` wrote."""
    return path.read_text(encoding="utf-8")


def put(path: Path, content: bytes) -> None:
    """Write a file, whole or not at all."""
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as out:
        out.write(content)
    os.replace(out.name, path)


def _imported(kernel: ModuleType) -> list[ModuleType]:
    """Modules of this package that a kernel imports from."""
    nodes = ast.parse(inspect.getsource(kernel)).body
    names = {n.module for n in nodes if isinstance(n, ast.ImportFrom) and n.module and "equimus_ctrl" in n.module}
    return [sys.modules[name] for name in sorted(names - {_STUB, lane_functions.__name__})]


def _source(form: Structure, phase: Phase) -> str:
    m = symbolic.build(form, phase)
    nj, na = m.q.numel(), m.f.numel()
    drive = m.jacobian.T @ ca.diag(m.area)
    routines = [
        codegen.Routine("actuator_lengths", {"q": m.q}, m.lengths),
        codegen.Routine("actuator_areas", {}, m.area),
        codegen.Routine("static_pressure", {"q": m.q}, m.static_pressure),
        codegen.Routine("torque_pressure", {"q": m.q, "tau": m.tau}, symbolic_model.pseudo_solve(drive, m.tau)),
        codegen.Routine("pressure_torque", {"q": m.q, "f": m.f}, drive @ m.f),
    ]
    functions = codegen.generate(routines, m.p, DECORATOR)
    header = [
        "# Generated; safe to delete.",
        "from __future__ import annotations\n",
        "import math\n",
        "import numpy as np",
        "from numba import njit\n",
        f"N_JOINTS = {nj}",
        f"N_ACTUATORS = {na}\n\n",
    ]
    return "\n".join([*header, functions, "", _tuples(nj, na)])


def _mjcf_source(laws: Laws) -> str:
    symbols = [{key: ca.SX.sym(f"{law.name}_{key}") for key in law.parameter_info()} for law in laws]
    count = max(sum(law.n_states for law in laws), 1)
    x, rate, load, dt, time = (ca.SX.sym(name) for name in ("x", "rate", "load", "dt", "time"))
    z = ca.SX.sym("z", count)
    speed, states = ca.fabs(rate), ca.vertsplit(z)
    force, bound, used = ca.SX(0), ca.SX(0), 0
    rates, starts = [ca.SX(0)] * count, [ca.SX(0)] * count
    for law, p in zip(laws, symbols, strict=True):
        own = states[used : used + law.n_states]
        force += law.force(x, rate, own, p) + law.force_of_drive(load, p)
        bound += law.dry_friction(x, speed, p) + law.friction_of_load(ca.fabs(load), speed, p)
        rates[used : used + law.n_states] = [ca.SX(r) for r in law.state_rate(x, rate, own, p)]
        starts[used : used + law.n_states] = [ca.SX(s) for s in law.start_state(x, rate, time, p)]
        used += law.n_states
    changes = [state_change(rates[k], states[k], dt) for k in range(count)]
    at = ca.vertcat(x, rate, load, dt)
    routines = [
        codegen.Routine("joint_force", {"x": at, "z": z}, ca.vertcat(force, ca.fmax(bound, 0), *changes)),
        codegen.Routine("joint_start", {"x": ca.vertcat(x, rate, time)}, ca.vertcat(*starts)),
    ]
    text = codegen.generate(routines, ca.vertcat(*[s for p in symbols for s in p.values()]), DECORATOR)
    entries = ", ".join(f"values[{i}]" for i in range(count))
    header = [
        "# Generated; safe to delete.",
        "from __future__ import annotations\n",
        "import math\n",
        "import numpy as np",
        "from numba import njit\n",
        f"N_STATES = {count}\n",
    ]
    return "\n".join([*header, text, f"\n{DECORATOR}\ndef state_tuple(values):\n    return ({entries},)\n"])


def _tuples(nj: int, na: int) -> str:
    def one(name: str, n: int) -> str:
        entries = ", ".join(f"values[{i}]" for i in range(n))
        return f"{DECORATOR}\ndef {name}(values):\n    return ({entries},)\n"

    return one("joint_tuple", nj) + "\n\n" + one("actuator_tuple", na)
