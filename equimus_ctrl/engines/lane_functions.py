"""What the generator writes for each structure and set of laws; the lane kernel is written against these.

Units here and in the kernels are those of hinges and pressures: rad, N·m, Pa. Of slides m takes the place of rad and N
of N·m, and where commands are no pressures their own unit that of Pa.

A lane is one parameter set. All lanes' numbers live in one flat work array w: entry l of row r at r·LANES + l. The
rows ROW_* hold, in this order: the state x = (q, v, z), its derivative, a sum of derivatives, the state at the start
of a step, pressures, held friction, what friction needs, what joint stops need, the time since the recording
began at a start, and the constants that ``prepare_lane`` makes from a parameter vector.
"""

from __future__ import annotations

from equimus_ctrl.types import Array

LANES = 8
"""As many doubles as the widest vector registers hold."""

N_JOINTS = 0
N_ACTUATORS = 0
N_STATES = 0
N_ROWS = 0
N_LIMITS = 0
WORK_ROWS = 0
BOUNDED = False
"""Whether states may have bounds."""
SHORT = False
"""Whether there is ``lane_whole_step``."""
QUICK_INSIDE = False
"""Whether states of a robot's own or of laws may be faster than steps that follow its motion."""
SOFT_LIMITS = False
"""Whether a limit is pressed hangs on accelerations."""

ROW_X = 0
ROW_RATE = 0
ROW_SUM = 0
ROW_START = 0
ROW_PRESSURE = 0
ROW_PER_IMPULSE = 0
ROW_DELASSUS = 0
ROW_BOUND = 0
ROW_SPAN = 0
ROW_SLIP = 0
ROW_PHI = 0
ROW_SIDE = 0
ROW_SOUGHT = 0
ROW_WORST = 0
ROW_PRESSED = 0
ROW_GRIP = 0
ROW_PULL = 0
ROW_GAPS = 0
ROW_DEPTHS = 0
ROW_QUICK = 0
ROW_MEAN = 0
ROW_SLOPE = 0
ROW_DT = 0
ROW_FROM = 0
ROW_PART = 0
ROW_BEGIN = 0
ROW_END = 0
ROW_TIME = 0
ROW_CONSTANTS = 0


def prepare_lane(p: Array, w: Array, l: int) -> None:  # noqa: E741
    """Write the constants of the parameter vector p into lane l."""
    raise NotImplementedError


def lane_motion(w: Array) -> None:
    """From state, pressure, friction and what limits do: acceleration and the effects' rates, below v in ROW_RATE."""
    raise NotImplementedError


def lane_rates(w: Array) -> None:
    """From state and pressure: rates of the rows of z, below those of q and v in ROW_RATE."""
    raise NotImplementedError


def lane_whole_step(w: Array) -> None:
    """From ROW_START, friction, ROW_MEAN to ROW_PART: the state after a Runge–Kutta step with no limit pressed."""
    raise NotImplementedError


def lane_grips(w: Array) -> None:
    """From the rows of q, v and pressed limits: ROW_GRIP and ROW_PULL, what those do."""
    raise NotImplementedError


def lane_start(w: Array) -> None:
    """From the rows of q and v and ROW_TIME: the effects' states where a trial starts, into the rows of z."""
    raise NotImplementedError


def lane_keep(w: Array) -> None:
    """The rows of z: states within their bounds."""
    raise NotImplementedError


def lane_friction(w: Array) -> None:
    """From state, pressure, ROW_GRIP, ROW_DT and the start's q and v: ROW_PER_IMPULSE to ROW_SLIP."""
    raise NotImplementedError


def lane_sides(w: Array) -> None:
    """From ROW_DELASSUS to ROW_SOUGHT: ROW_SIDE, at which bound friction is or 0, and ROW_SOUGHT, where it changed."""
    raise NotImplementedError


def lane_hold(w: Array) -> None:
    """From ROW_DELASSUS to ROW_SOUGHT: ROW_SLIP and ROW_PHI with what sticks held, where friction is sought."""
    raise NotImplementedError


def lane_rub(w: Array) -> None:
    """From ROW_PER_IMPULSE, ROW_SPAN, ROW_PHI and the earlier friction, in ROW_SUM: the new rows of q and v."""
    raise NotImplementedError


def lane_depths(w: Array) -> None:
    """From the rows of q: ROW_DEPTHS, above 0 where a coordinate is beyond its limit."""
    raise NotImplementedError


def lane_gaps(w: Array) -> None:
    """From the rows of q, v and accelerations below v in ROW_RATE: ROW_GAPS, above 0 where a limit would be pressed."""
    raise NotImplementedError


def lane_quickness(w: Array) -> None:
    """From state and pressed limits: ROW_QUICK, about the fastest rate of the motion [1/s]."""
    raise NotImplementedError
