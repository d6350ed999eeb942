"""What a structure and set of laws bring to the lane kernels: sizes, places, and machine code called by address.

The kernels are the same for every robot and compiled once; what is generated for a structure is its functions alone. A
kernel's first argument ``robot`` (``LENGTH``,) says how many of what there are, where in the work array they stand, and
where the functions lie in memory.

Units here and in the kernels are those of hinges and pressures: rad, N·m, Pa. Of slides m takes the place of rad and N
of N·m, and where commands are no pressures their own unit that of Pa.

A lane is one parameter set. All lanes' numbers live in one flat work array w: entry l of row r at r·LANES + l. The
rows ROW_* hold, in this order: the state x = (q, v, z), its derivative, a sum of derivatives, the state at the start
of a step, pressures, held friction, what friction needs, what joint stops need, the time since the recording
began at a start, and the constants that ``prepare_lane`` makes from a parameter vector.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped, unused-ignore]
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from equimus_ctrl.types import Array

_Function = TypeVar("_Function", bound=Callable[..., Any])

Layout = NDArray[np.int64]
"""(``LENGTH``,) of a structure with its laws, indexed by what follows."""

LANES = 8
"""As many doubles as the widest vector registers hold."""

N_JOINTS, N_ACTUATORS, N_STATES, N_ROWS, N_LIMITS = range(5)
"""How many: coordinates, commands, states of laws and of the robot's own, rows of dry friction, limits of joints."""
N_STATE, WORK_ROWS = 5, 6
"""How many numbers the whole state has, and rows the work array."""
BOUNDED = 7
"""Whether states may have bounds."""
SHORT = 8
"""Whether there is ``lane_whole_step``."""
QUICK_INSIDE = 9
"""Whether states of a robot's own or of laws may be faster than steps that follow its motion."""
SOFT_LIMITS = 10
"""Whether a limit is pressed hangs on accelerations."""

# The first row of each part of the work array.
ROW_X, ROW_RATE, ROW_SUM, ROW_START, ROW_PRESSURE, ROW_PER_IMPULSE, ROW_DELASSUS, ROW_BOUND = range(11, 19)
ROW_SPAN, ROW_SLIP, ROW_PHI, ROW_SIDE, ROW_SOUGHT, ROW_WORST, ROW_PRESSED, ROW_GRIP = range(19, 27)
ROW_PULL, ROW_GAPS, ROW_DEPTHS, ROW_QUICK, ROW_MEAN, ROW_SLOPE, ROW_DT, ROW_FROM = range(27, 35)
ROW_PART, ROW_BEGIN, ROW_END, ROW_TIME, ROW_CONSTANTS, ROW_INTO, ROW_H, ROW_WEIGHT, ROW_SIXTH = range(35, 44)

# Where the functions are.
PREPARE, MOTION, RATES, WHOLE_STEP, GRIPS, START, KEEP = range(44, 51)
FRICTION, SIDES, HOLD, RUB, DEPTHS, GAPS, QUICKNESS = range(51, 58)
DRIVE, SUM, PUSH, REACH = range(58, 62)
LENGTH = 62


bare: Callable[[_Function], _Function] = njit(cache=True, nogil=True, error_model="numpy", _nrt=False)  # type: ignore[call-overload, unused-ignore]
"""Compiles what allocates nothing, without counts of who uses an array: a step would count hundreds of times."""


def _call(_: Any, address: Any, work: Any) -> Any:
    """Call ``void f(double *w)`` at an address."""

    def written(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        data = context.make_array(signature.args[1])(context, builder, given[1]).data
        kind = ir.FunctionType(ir.VoidType(), [ir.DoubleType().as_pointer()])
        builder.call(builder.inttoptr(given[0], kind.as_pointer()), [data])
        return context.get_dummy_value()

    return types.void(types.int64, work), written


def _call_with(_: Any, address: Any, numbers: Any, work: Any, lane: Any) -> Any:
    """Call ``void f(double *p, double *w, int64 l)`` at an address."""

    def written(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        numbers, work = (context.make_array(signature.args[k])(context, builder, given[k]).data for k in (1, 2))
        pointer = ir.DoubleType().as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer, pointer, cgutils.intp_t])
        builder.call(builder.inttoptr(given[0], kind.as_pointer()), [numbers, work, given[3]])
        return context.get_dummy_value()

    return types.void(types.int64, numbers, work, types.int64), written


call: Any = intrinsic(_call)
call_with: Any = intrinsic(_call_with)


@bare
def fill_row(w: Array, row: int, value: float) -> None:
    """Write a number into all lanes of a row."""
    for l in range(LANES):  # noqa: E741
        w[row * LANES + l] = value


@bare
def copy_rows(w: Array, source: int, target: int, rows: int) -> None:
    """Copy whole rows within the work array."""
    at, to = source * LANES, target * LANES
    for i in range(rows * LANES):
        w[to + i] = w[at + i]


@bare
def prepare_lane(robot: Layout, p: Array, w: Array, l: int) -> None:  # noqa: E741
    """Write the constants of the parameter vector p into lane l."""
    call_with(robot[PREPARE], p, w, l)


@bare
def lane_motion(robot: Layout, w: Array) -> None:
    """From state, pressure, friction and what limits do: the state's derivative, in ROW_RATE."""
    call(robot[MOTION], w)


@bare
def lane_rates(robot: Layout, w: Array) -> None:
    """From state and pressure: rates of the rows of z, below those of q and v in ROW_RATE."""
    call(robot[RATES], w)


@bare
def lane_whole_step(robot: Layout, w: Array) -> None:
    """From ROW_START, friction, ROW_MEAN to ROW_PART: the state after a Runge–Kutta step with no limit pressed."""
    call(robot[WHOLE_STEP], w)


@bare
def lane_grips(robot: Layout, w: Array) -> None:
    """From the rows of q, v and pressed limits: ROW_GRIP and ROW_PULL, what those do."""
    call(robot[GRIPS], w)


@bare
def lane_start(robot: Layout, w: Array) -> None:
    """From the rows of q and v and ROW_TIME: the effects' states where a trial starts, into the rows of z."""
    call(robot[START], w)


@bare
def lane_keep(robot: Layout, w: Array) -> None:
    """The rows of z: states within their bounds."""
    call(robot[KEEP], w)


@bare
def lane_friction(robot: Layout, w: Array) -> None:
    """From state, pressure, ROW_GRIP, ROW_DT and the start's q and v: ROW_PER_IMPULSE to ROW_SLIP."""
    call(robot[FRICTION], w)


@bare
def lane_sides(robot: Layout, w: Array) -> None:
    """From ROW_DELASSUS to ROW_SOUGHT: ROW_SIDE, at which bound friction is or 0, and ROW_SOUGHT, where it changed."""
    call(robot[SIDES], w)


@bare
def lane_hold(robot: Layout, w: Array) -> None:
    """From ROW_DELASSUS to ROW_SOUGHT: ROW_SLIP and ROW_PHI with what sticks held, where friction is sought."""
    call(robot[HOLD], w)


@bare
def lane_rub(robot: Layout, w: Array) -> None:
    """From ROW_PER_IMPULSE, ROW_SPAN, ROW_PHI and the earlier friction, in ROW_SUM: the new rows of q and v."""
    call(robot[RUB], w)


@bare
def lane_depths(robot: Layout, w: Array) -> None:
    """From the rows of q: ROW_DEPTHS, above 0 where a coordinate is beyond its limit."""
    call(robot[DEPTHS], w)


@bare
def lane_gaps(robot: Layout, w: Array) -> None:
    """From the rows of q, v and accelerations below v in ROW_RATE: ROW_GAPS, above 0 where a limit would be pressed."""
    call(robot[GAPS], w)


@bare
def lane_quickness(robot: Layout, w: Array) -> None:
    """From state and pressed limits: ROW_QUICK, about the fastest rate of the motion [1/s]."""
    call(robot[QUICKNESS], w)


@bare
def lane_drive(robot: Layout, w: Array) -> None:
    """From ROW_MEAN, ROW_SLOPE, ROW_FROM, ROW_PART and ROW_INTO, a share of the part: the pressures then."""
    call(robot[DRIVE], w)


@bare
def lane_sum(robot: Layout, w: Array) -> None:
    """Add the derivative, ROW_WEIGHT times, to ROW_SUM."""
    call(robot[SUM], w)


@bare
def lane_push(robot: Layout, w: Array) -> None:
    """From ROW_START along the derivative, over ROW_H, a time, times ROW_PART: the state."""
    call(robot[PUSH], w)


@bare
def lane_reach(robot: Layout, w: Array) -> None:
    """From ROW_START along ROW_SUM, over ROW_SIXTH, a time, times ROW_PART: the state, tiny numbers as nothing."""
    call(robot[REACH], w)
