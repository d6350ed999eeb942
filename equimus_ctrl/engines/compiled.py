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
    lane_objects,
    lane_steps,
    mjcf_functions,
    mjcf_kernel,
)
from equimus_ctrl.engines.limits import NOTHING, SLIDING
from equimus_ctrl.models import (
    actuator_laws,
    augmented,
    codegen,
    elastic_equations,
    lane_code,
    mjcf_equations,
    parts,
    sticking,
    symbolic,
    symbolic_model,
    tree,
)
from equimus_ctrl.models.augmented import Laws, expressions, state_change
from equimus_ctrl.robots.elastic import form as elastic_form
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, pack, structure
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.robots.mjcf import form as mjcf_form
from equimus_ctrl.robots.mjcf import packing
from equimus_ctrl.types import Array

DECORATOR = '@njit(cache=True, nogil=True, error_model="numpy")'
_STUB = "equimus_ctrl.engines.model_functions"
_LANE_STUB = "equimus_ctrl.engines.lane_functions"
LANE_KERNELS = (lane_begin, lane_steps, lane_dry_friction, lane_hidden, lane_kernel)
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


def load(model: Morphology, phase: Phase, kernel: ModuleType, laws: Laws = ()) -> ModuleType:
    """The compiled counterpart of a kernel module for a morphology's structure.

    Args:
        model: whose structure; its parameters are arguments of the kernels.
        phase: base fixed or foot pinned.
        kernel: a module written against ``engines.model_functions``; it may import from other such modules, and from
            ``engines.lane_functions`` and the kernels written against that (``LANE_KERNELS``).
        laws: force laws that the lanes have wherever they can sit.
    """
    return _load(structure(model), phase, kernel, laws)


@lru_cache(maxsize=8)
def load_mjcf(laws: Laws) -> tuple[ModuleType, ModuleType]:
    """What is generated for laws at joints of MJCF robots, and the kernel (``engines.mjcf_kernel``) with it."""
    generated = _generated("mjcf_laws", _mjcf_source(laws), [])
    return generated, _led(mjcf_kernel, {mjcf_functions.__name__: generated})


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


@lru_cache(maxsize=64)
def load_lanes(form: Structure, phase: Phase, laws: Laws) -> ModuleType:
    """The batch kernel (see ``engines.lane_kernel``) of a structure with force laws wherever they can sit."""
    return _lane_modules(form, phase, laws)[lane_kernel.__name__]


@lru_cache(maxsize=64)
def _lane_modules(form: Structure, phase: Phase, laws: Laws) -> dict[str, ModuleType]:
    """What takes the place of each module that is written against the lanes' functions."""
    made = {_LANE_STUB: _lane_model(form, phase, laws)}
    for module in LANE_KERNELS:
        made[module.__name__] = _led(module, made)
    return made


@lru_cache(maxsize=64)
def _load(form: Structure, phase: Phase, kernel: ModuleType, laws: Laws) -> ModuleType:
    replaced = {_STUB: _model(form, phase)}
    if _LANE_STUB in inspect.getsource(kernel):
        replaced |= _lane_modules(form, phase, laws)
    for other in _imported(kernel):
        if _STUB in inspect.getsource(other):
            replaced[other.__name__] = _load(form, phase, other, ())
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
    key = _digest([repr((form, phase)), *sources])
    path = cache_folder() / f"equimus_model_{key}.py"
    text = path.read_text(encoding="utf-8") if path.exists() else _source(form, phase)
    return _written(path, text)


@lru_cache(maxsize=64)
def _lane_model(form: Structure, phase: Phase, laws: Laws) -> ModuleType:
    """The functions of ``engines.lane_functions`` for one structure and set of laws."""
    # Laws may call upon anything: what they say enters as expressions, which are short, not as sources.
    said = [expressions(law) for law in laws]
    key = _digest([repr((form, phase)), lane_code.computer(), *_sources(), *said])
    path = cache_folder() / f"equimus_lanes_{key}.py"
    if path.exists() and path.with_suffix(".o").exists():
        return _written(path, path.read_text(encoding="utf-8"))
    code, text = _lane_source(form, phase, laws, f"equimus_{key}")
    _put(path.with_suffix(".o"), code)
    return _written(path, text)


@lru_cache(maxsize=1)
def _sources() -> list[str]:
    """All that generated lanes are made by, without the laws."""
    modules = (
        augmented, codegen, elastic_equations, elastic_form, lane_code, lane_functions, mjcf_equations, mjcf_form,
        packing, actuator_laws, parts, sticking, symbolic, symbolic_model, tree, sys.modules[__name__],
    )  # fmt: skip
    return [inspect.getsource(module) for module in modules]


def _generated(label: str, text: str, depends: list[str]) -> ModuleType:
    return _written(cache_folder() / f"equimus_{label}_{_digest([text, *depends])}.py", text)


def _digest(parts: list[str]) -> str:
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
            _put(path, text.encode())
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


def _put(path: Path, content: bytes) -> None:
    """Write a file, whole or not at all."""
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as out:
        out.write(content)
    os.replace(out.name, path)


def _imported(kernel: ModuleType) -> list[ModuleType]:
    """Modules of this package that a kernel imports from."""
    nodes = ast.parse(inspect.getsource(kernel)).body
    names = {n.module for n in nodes if isinstance(n, ast.ImportFrom) and n.module and "equimus_ctrl" in n.module}
    return [sys.modules[name] for name in sorted(names - {_STUB, _LANE_STUB})]


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


SHORT = 290
"""Up to so many operations of its equations of motion a whole Runge–Kutta step is written out at once."""


def _operations(m: augmented.AugmentedModel) -> int:
    """Of the equations of motion."""
    inputs = [m.q, m.v, m.z, m.pressure, m.phi, m.grip, m.pull, m.p]
    return int(ca.Function("motion", inputs, [ca.cse(ca.densify(m.gripped_acceleration))]).n_instructions())


def _whole_step(m: augmented.AugmentedModel, symbols: dict[str, ca.SX]) -> ca.SX:
    """The state after a Runge–Kutta step of order four with no limit pressed, see ``lane_steps.advance``."""
    grips = ca.vertcat(m.grip, m.pull)
    motion = ca.vertcat(m.v, m.gripped_acceleration, m.z_rate)
    motion = ca.substitute(motion, grips, ca.SX.zeros(grips.numel()))
    rate = ca.Function("rate", [m.q, m.v, m.z, m.pressure, m.phi, m.p], [motion])
    nj, state = m.q.numel(), ca.vertcat(m.q, m.v, m.z)
    lasts = symbols["dt"] * symbols["part"]
    at, whole = state, ca.SX.zeros(state.numel())
    for into, weight, then in ((0.0, 1.0, 0.5), (0.5, 2.0, 0.5), (0.5, 2.0, 1.0), (1.0, 1.0, 0.0)):
        pressure = symbols["mean"] + (symbols["begin"] + into * symbols["part"] - 0.5) * symbols["slope"]
        found = rate(at[:nj], at[nj : 2 * nj], at[2 * nj :], pressure, m.phi, m.p)
        whole, at = whole + weight * found, state + then * lasts * found
    reached = state + lasts / 6.0 * whole
    return reached * (ca.fabs(reached) >= NOTHING)


def _friction_routines(
    m: augmented.AugmentedModel, rows: dict[str, int], state: dict[str, int]
) -> list[lane_code.LaneRoutine]:
    """What finds dry friction at a step's end, and what it changes."""
    nj, nr = m.q.numel(), m.phi.numel()
    dt, earlier = ca.SX.sym("dt"), ca.SX.sym("earlier", nr)
    # What changes with a turn does so from then on; with nothing that turns, from the start of the step.
    turns = (m.rows_before * m.rows < 0) * (ca.fabs(m.rows_before) > SLIDING)
    span = ca.if_else(turns, dt * m.rows / (m.rows - m.rows_before), dt)
    s = sticking.sticking(nr)
    per_impulse = ca.SX.sym("per_impulse", nj, nr)
    impulse = (s.phi - earlier) * s.span
    moved = ca.vertcat(m.q + per_impulse @ (0.5 * s.span * impulse), m.v + per_impulse @ impulse)
    at = {name: rows[name.upper()] for name in ("side", "sought", "phi", "slip", "bound", "span", "per_impulse")}
    at |= {
        "mobility": rows["DELASSUS"],
        "earlier": rows["SUM"],
        "dt": rows["DT"],
        "q0": rows["START"],
        "v0": rows["START"] + nj,
    }
    at |= {"pressure": rows["PRESSURE"], "grip": rows["GRIP"], **state}
    known = {"mobility": s.mobility, "bound": s.bound, "span": s.span, "slip": s.slip, "phi": s.phi, "side": s.side}
    known |= {"sought": s.sought}
    return [
        lane_code.LaneRoutine(
            "lane_friction",
            {"q": m.q, "v": m.v, "z": m.z, "pressure": m.pressure, "grip": m.grip, "q0": m.q0, "v0": m.v0, "dt": dt},
            ca.vertcat(ca.vec(m.per_impulse), ca.vec(m.delassus), m.bound, span, m.rows),
            at,
            at["per_impulse"],
        ),
        lane_code.LaneRoutine("lane_sides", known, ca.vertcat(s.sides, s.still_sought), at, at["side"]),
        lane_code.LaneRoutine("lane_hold", known, s.found, at, at["slip"]),
        lane_code.LaneRoutine(
            "lane_rub",
            {"q": m.q, "v": m.v, "per_impulse": per_impulse, "phi": s.phi, "span": s.span, "earlier": earlier},
            moved,
            at,
            at["q"],
        ),
    ]


def _lane_source(form: Structure, phase: Phase, laws: Laws, prefix: str) -> tuple[bytes, str]:
    """Machine code of the lanes' functions, and the module by which numba's functions call it."""
    m = augmented.augmented_model(form, phase, laws)
    nj, na, nz, nr = m.q.numel(), m.pressure.numel(), m.z.numel(), m.phi.numel()
    nl = m.pressed.numel()
    nx = 2 * nj + nz
    sizes = {
        "X": nx, "RATE": nx, "SUM": max(nx, nr), "START": nx, "PRESSURE": na,
        "PER_IMPULSE": nj * nr, "DELASSUS": nr * nr, "BOUND": nr, "SPAN": nr, "SLIP": nr, "PHI": nr,
        "SIDE": nr, "SOUGHT": 1, "WORST": 1,
        "PRESSED": nl, "GRIP": nl, "PULL": nl, "GAPS": nl, "DEPTHS": nl, "QUICK": 1,
        "MEAN": na, "SLOPE": na, "DT": 1, "FROM": 1, "PART": 1, "BEGIN": nx, "END": nx, "TIME": 1,
    }  # fmt: skip
    row, rows = 0, {}
    for name, size in sizes.items():
        rows[name] = row
        row += size
    x, at_start = rows["X"], rows["START"]
    state = {"q": x, "v": x + nj, "z": x + 2 * nj}
    moving = {"q": m.q, "v": m.v, "z": m.z, "pressure": m.pressure, "phi": m.phi, "grip": m.grip, "pull": m.pull}
    moving_rows = state | {name: rows[name.upper()] for name in ("pressure", "phi", "grip", "pull")}
    reached_rows = {"q": x, "v": x + nj, "a": rows["RATE"] + nj}
    routines = [
        lane_code.LaneRoutine(
            "lane_motion", moving, ca.vertcat(m.gripped_acceleration, m.z_rate), moving_rows, rows["RATE"] + nj
        ),
        lane_code.LaneRoutine(
            "lane_rates",
            {"q": m.q, "v": m.v, "z": m.z, "pressure": m.pressure},
            m.z_rate,
            {**state, "pressure": rows["PRESSURE"]},
            rows["RATE"] + 2 * nj,
        ),
        lane_code.LaneRoutine(
            "lane_grips",
            {"q": m.q, "v": m.v, "pressed": m.pressed},
            m.grips,
            {"q": x, "v": x + nj, "pressed": rows["PRESSED"]},
            rows["GRIP"],
        ),
        lane_code.LaneRoutine("lane_depths", {"q": m.q}, m.depths, {"q": x}, rows["DEPTHS"]),
        lane_code.LaneRoutine("lane_gaps", {"q": m.q, "v": m.v, "a": m.a}, m.gaps, reached_rows, rows["GAPS"]),
        lane_code.LaneRoutine(
            "lane_quickness",
            {"q": m.q, "v": m.v, "z": m.z, "pressed": m.pressed},
            m.quickness,
            {**state, "pressed": rows["PRESSED"]},
            rows["QUICK"],
        ),
        lane_code.LaneRoutine("lane_keep", {"z": m.z}, m.kept, {"z": state["z"]}, state["z"]),
        lane_code.LaneRoutine(
            "lane_start",
            {"q": m.q, "v": m.v, "time": m.time},
            m.start_state,
            {"q": x, "v": x + nj, "time": rows["TIME"]},
            x + 2 * nj,
        ),
        *_friction_routines(m, rows, state),
    ]
    short = m.z.numel() == 0 and _operations(m) <= SHORT
    symbols = {"mean": ca.SX.sym("mean", na), "slope": ca.SX.sym("slope", na)}
    symbols |= {name: ca.SX.sym(name) for name in ("begin", "part", "dt")}
    begins = {"q": at_start, "v": at_start + nj, "z": at_start + 2 * nj, "phi": rows["PHI"], "mean": rows["MEAN"]}
    begins |= {"slope": rows["SLOPE"], "begin": rows["FROM"], "part": rows["PART"], "dt": rows["DT"]}
    step = _whole_step(m, symbols) if short else ca.SX(0, 1)
    inputs = {"q": m.q, "v": m.v, "z": m.z, "phi": m.phi} | symbols
    routines.append(lane_code.LaneRoutine("lane_whole_step", inputs, step, begins, x))
    made = lane_code.generate_lanes(routines, m.p, lane_functions.LANES, prefix, row)
    counts = {"JOINTS": nj, "ACTUATORS": na, "STATES": nz, "ROWS": nr, "LIMITS": nl}
    header = [
        "# Generated; safe to delete.",
        "from __future__ import annotations\n",
        "from pathlib import Path\n",
        "from numba import njit",
        "from numba.core.types import CPointer, ExternalFunction, float64, intp, void\n",
        f"from {lane_objects.__name__} import load\n",
        f"LANES = {lane_functions.LANES}",
        *[f"N_{name} = {count}" for name, count in counts.items()],
        f"WORK_ROWS = {made.rows}",
        f"BOUNDED = {form.n_inside > 0}",
        f"SHORT = {short}",
        f"QUICK_INSIDE = {_quick_inside(form, phase, laws)}",
        f"SOFT_LIMITS = {any(limit.force is None for limit in symbolic.build(form, phase).limits)}",
        *[f"ROW_{name} = {first}" for name, first in rows.items()],
        f"ROW_CONSTANTS = {row}\n",
        f"load(Path(__file__).with_suffix('.o'), '{prefix}', {('prepare', *made.names)})\n\n",
        f"_prepare = ExternalFunction('{prefix}_prepare', void(CPointer(float64), CPointer(float64), intp))\n\n",
        f"{DECORATOR}\ndef prepare_lane(p, w, l):\n    _prepare(p.ctypes, w.ctypes, l)\n",
    ]
    for name in made.names:
        header.append(
            f"\n_{name} = ExternalFunction('{prefix}_{name}', void(CPointer(float64)))\n\n\n"
            f"{DECORATOR}\ndef {name}(w):\n    _{name}(w.ctypes)\n"
        )
    return made.code, "\n".join(header)


def _quick_inside(form: Structure, phase: Phase, laws: Laws) -> bool:
    """Whether states of the robot's own or of laws may be faster than steps that follow its motion."""
    own = symbolic.build(form, phase).inside.quickness
    return not own.is_zero() or any(law.quick_states for law in laws)


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
