"""A structure's equations of motion with force laws, for the lane kernels: generated, compiled and kept on disk."""

from __future__ import annotations

import inspect
import json
import sys
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType

import casadi as ca
import numpy as np

from equimus_ctrl.engines import lane_functions, lane_kernel, lane_objects
from equimus_ctrl.engines.compiled import cache_folder, digest, kept, lane_modules, put
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
from equimus_ctrl.models.augmented import Laws, expressions
from equimus_ctrl.robots.elastic import form as elastic_form
from equimus_ctrl.robots.elastic.morphology import Phase
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.robots.mjcf import form as mjcf_form
from equimus_ctrl.robots.mjcf import packing
from equimus_ctrl.types import Array

FUNCTIONS = {
    "prepare": lane_functions.PREPARE,
    "lane_motion": lane_functions.MOTION,
    "lane_rates": lane_functions.RATES,
    "lane_whole_step": lane_functions.WHOLE_STEP,
    "lane_grips": lane_functions.GRIPS,
    "lane_start": lane_functions.START,
    "lane_keep": lane_functions.KEEP,
    "lane_friction": lane_functions.FRICTION,
    "lane_sides": lane_functions.SIDES,
    "lane_hold": lane_functions.HOLD,
    "lane_rub": lane_functions.RUB,
    "lane_depths": lane_functions.DEPTHS,
    "lane_gaps": lane_functions.GAPS,
    "lane_quickness": lane_functions.QUICKNESS,
    "lane_drive": lane_functions.DRIVE,
    "lane_sum": lane_functions.SUM,
    "lane_push": lane_functions.PUSH,
    "lane_reach": lane_functions.REACH,
}
"""Of a structure's own, and where the kernels are told of each."""
SHORT = 290
"""Up to so many operations of its equations of motion a whole Runge–Kutta step is written out at once."""


@dataclass(frozen=True, eq=False)
class Lanes:
    """The equations of motion of a structure with force laws, and the kernels that run them.

    Attributes:
        robot: (n,) what kernels take as their first argument, see ``engines.lane_functions``.
        kernel: ``engines.lane_kernel``, compiled.
        key: says what the functions were made from.
    """

    robot: lane_functions.Layout
    kernel: ModuleType
    key: str

    @property
    def n_joints(self) -> int:
        """How many coordinates there are."""
        return int(self.robot[lane_functions.N_JOINTS])

    @property
    def n_actuators(self) -> int:
        """How many commands."""
        return int(self.robot[lane_functions.N_ACTUATORS])

    @property
    def n_states(self) -> int:
        """How many states of laws and of the robot's own."""
        return int(self.robot[lane_functions.N_STATES])

    @property
    def n_state(self) -> int:
        """How many numbers the whole state has."""
        return int(self.robot[lane_functions.N_STATE])

    @property
    def n_rows(self) -> int:
        """At how many places there may be dry friction."""
        return int(self.robot[lane_functions.N_ROWS])

    @property
    def n_limits(self) -> int:
        """How many limits of joints."""
        return int(self.robot[lane_functions.N_LIMITS])

    def work(self) -> Array:
        """An empty work array."""
        return np.zeros(self.robot[lane_functions.WORK_ROWS] * lane_functions.LANES)


@lru_cache(maxsize=64)
def load_lanes(form: Structure, phase: Phase, laws: Laws) -> Lanes:
    """The equations of a structure with force laws wherever they can sit, for the lane kernels."""
    robot, key = _lane_model(form, phase, laws)
    return Lanes(robot, lane_modules()[lane_kernel.__name__], key)


def _lane_model(form: Structure, phase: Phase, laws: Laws) -> tuple[lane_functions.Layout, str]:
    """What the lane kernels are told of a structure and set of laws, and a key; its functions stay with the process."""
    # Laws may call upon anything: what they say enters as expressions, which are short, not as sources.
    said = [expressions(law) for law in laws]
    key = digest([repr((form, phase)), lane_code.computer(), *_sources(), *said])
    prefix, path = f"equimus_{key}", cache_folder() / f"equimus_lanes_{key}.json"
    code = path.with_suffix(".o")
    if not (path.exists() and code.exists()):
        machine_code, described = _lane_source(form, phase, laws, prefix)
        put(code, machine_code)
        put(path, json.dumps(described).encode())
    robot = np.array(json.loads(kept(path)), dtype=np.int64)
    addresses = lane_objects.load(code, prefix, tuple(FUNCTIONS))
    for name, place in FUNCTIONS.items():
        robot[place] = addresses[name]
    return robot, key


@lru_cache(maxsize=1)
def _sources() -> list[str]:
    """All that generated lanes are made by, without the laws."""
    modules = (
        augmented, codegen, elastic_equations, elastic_form, lane_code, lane_functions, mjcf_equations, mjcf_form,
        packing, actuator_laws, parts, sticking, symbolic, symbolic_model, tree, sys.modules[__name__],
    )  # fmt: skip
    return [inspect.getsource(module) for module in modules]


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


def _stage_routines(nx: int, na: int, rows: dict[str, int]) -> list[lane_code.LaneRoutine]:
    """What a stage of a Runge–Kutta step does to whole states, see ``lane_steps.advance``; rounded as written."""
    into, h, weight, sixth, begun, part = (
        ca.SX.sym(name) for name in ("into", "h", "weight", "sixth", "begun", "part")
    )
    mean, slope = ca.SX.sym("mean", na), ca.SX.sym("slope", na)
    start, rate, total = (ca.SX.sym(name, nx) for name in ("start", "rate", "total"))
    reached = start + sixth * part * total
    of = {"into": "INTO", "h": "H", "weight": "WEIGHT", "sixth": "SIXTH", "begun": "FROM", "part": "PART"}
    of |= {"mean": "MEAN", "slope": "SLOPE", "start": "START", "rate": "RATE", "total": "SUM"}
    made = {
        "lane_drive": ("PRESSURE", mean + (begun + into * part - 0.5) * slope),
        "lane_sum": ("SUM", total + weight * rate),
        "lane_push": ("X", start + h * part * rate),
        "lane_reach": ("X", ca.if_else(ca.fabs(reached) < NOTHING, 0.0, reached)),
    }
    given = {symbol.name(): symbol for symbol in (into, h, weight, sixth, begun, part)}
    given |= {"mean": mean, "slope": slope, "start": start, "rate": rate, "total": total}
    places = {name: rows[row] for name, row in of.items()}
    return [
        lane_code.LaneRoutine(name, given, result, places, rows[row], contracts=False)
        for name, (row, result) in made.items()
    ]


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


def _lane_source(form: Structure, phase: Phase, laws: Laws, prefix: str) -> tuple[bytes, list[int]]:
    """Machine code of the lanes' functions, and what the kernels are told of them but for where they lie."""
    m = augmented.augmented_model(form, phase, laws)
    nj, na, nz, nr = m.q.numel(), m.pressure.numel(), m.z.numel(), m.phi.numel()
    nl = m.pressed.numel()
    nx = 2 * nj + nz
    sizes = {
        "X": nx, "RATE": nx, "SUM": max(nx, nr), "START": nx, "PRESSURE": na,
        "PER_IMPULSE": nj * nr, "DELASSUS": nr * nr, "BOUND": nr, "SPAN": nr, "SLIP": nr, "PHI": nr,
        "SIDE": nr, "SOUGHT": 1, "WORST": 1,
        "PRESSED": nl, "GRIP": nl, "PULL": nl, "GAPS": nl, "DEPTHS": nl, "QUICK": 1,
        "MEAN": na, "SLOPE": na, "INTO": 1, "H": 1, "WEIGHT": 1, "SIXTH": 1, "DT": 1,
        "FROM": 1, "PART": 1, "BEGIN": nx, "END": nx, "TIME": 1,
    }  # fmt: skip
    row, rows = 0, {}
    for name, size in sizes.items():
        rows[name] = row
        row += size
    rows["CONSTANTS"] = row
    x, at_start = rows["X"], rows["START"]
    state = {"q": x, "v": x + nj, "z": x + 2 * nj}
    moving = {"q": m.q, "v": m.v, "z": m.z, "pressure": m.pressure, "phi": m.phi, "grip": m.grip, "pull": m.pull}
    moving_rows = state | {name: rows[name.upper()] for name in ("pressure", "phi", "grip", "pull")}
    reached_rows = {"q": x, "v": x + nj, "a": rows["RATE"] + nj}
    routines = [
        lane_code.LaneRoutine(
            "lane_motion", moving, ca.vertcat(m.v, m.gripped_acceleration, m.z_rate), moving_rows, rows["RATE"]
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
        *_stage_routines(nx, na, rows),
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
    told = {
        lane_functions.N_JOINTS: nj,
        lane_functions.N_ACTUATORS: na,
        lane_functions.N_STATES: nz,
        lane_functions.N_ROWS: nr,
        lane_functions.N_LIMITS: nl,
        lane_functions.N_STATE: nx,
        lane_functions.WORK_ROWS: made.rows,
        lane_functions.BOUNDED: form.n_inside > 0,
        lane_functions.SHORT: short,
        lane_functions.QUICK_INSIDE: _quick_inside(form, phase, laws),
        lane_functions.SOFT_LIMITS: any(limit.force is None for limit in symbolic.build(form, phase).limits),
        **{getattr(lane_functions, f"ROW_{name}"): first for name, first in rows.items()},
    }
    return made.code, [int(told.get(place, 0)) for place in range(lane_functions.LENGTH)]


def _quick_inside(form: Structure, phase: Phase, laws: Laws) -> bool:
    """Whether states of the robot's own or of laws may be faster than steps that follow its motion."""
    own = symbolic.build(form, phase).inside.quickness
    return not own.is_zero() or any(law.quick_states for law in laws)
