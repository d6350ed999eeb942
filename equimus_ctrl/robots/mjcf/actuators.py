"""Actuators of an MJCF robot: what they drive, and their parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.errors import ModelError
from equimus_ctrl.robots.mjcf.entries import Axis, Drive, ModelParameter, setter
from equimus_ctrl.robots.mjcf.reading import INPUTS
from equimus_ctrl.types import Array

FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
"""Dynamics of actuators whose state follows from commands alone."""
MUSCLE = int(mujoco.mjtDyn.mjDYN_MUSCLE)
"""Dynamics of actuators whose state is an activation between 0 and 1 that follows from commands alone."""
OWN = (int(mujoco.mjtGain.mjGAIN_PID), int(mujoco.mjtGain.mjGAIN_DCMOTOR))
"""Laws with parameters of their own."""
_TRANSMISSIONS = tuple(
    getattr(mujoco.mjtTrn, f"mjTRN_{kind}") for kind in ("JOINT", "JOINTINPARENT", "TENDON", "SITE", "SLIDERCRANK")
)
_GAINS = tuple(getattr(mujoco.mjtGain, f"mjGAIN_{kind}") for kind in ("FIXED", "AFFINE", "PID", "DCMOTOR", "MUSCLE"))
_BIASES = tuple(getattr(mujoco.mjtBias, f"mjBIAS_{kind}") for kind in ("NONE", "AFFINE", "DCMOTOR", "MUSCLE"))
_DYNAMICS = tuple(
    getattr(mujoco.mjtDyn, f"mjDYN_{kind}")
    for kind in ("NONE", "FILTER", "FILTEREXACT", "INTEGRATOR", "PID", "DCMOTOR", "MUSCLE")
)
LEAST = 1e-15
"""MuJoCo's least divisor."""
AWAY = 0.3
"""From the file's own pose, where moment arms might vanish [rad or m]."""
TAKEN = (
    "motor, position, velocity, intvelocity, damper, cylinder, muscle, general with fixed or affine gain and bias, pid "
    "and dcmotor, at joints, tendons, sites and sliders with a crank"
)


def drives_of(base: Any, name: str, joints: Sequence[Axis], but: Sequence[str] = ()) -> tuple[Drive, ...]:
    """All commands of all actuators.

    Args:
        base: MuJoCo's model.
        name: of the robot, for messages.
        joints: all of it.
        but: actuators that are left out; where there are any, a robot needs no others to be moved.

    Raises:
        ModelError: for an actuator without a name, or of a kind that neither engine takes.
    """
    moments = _moments(base, mujoco.MjData(base))
    found: list[Drive] = []
    for i in (k for k in range(base.nactuator) if base.actuator(k).name not in but):
        found += _commands(base, i, name, joints, moments[int(base.actuator_outadr[i])])
    if not found and not but:
        raise ModelError(f"{name}: has no actuator with a command; --motors gives each joint a motor")
    return tuple(found)


def _moments(base: Any, data: Any) -> Array:
    """(nout, nv) moments of actuators where a robot is."""
    mujoco.mj_forward(base, data)
    moments = np.zeros((base.nout, base.nv))
    mujoco.mju_sparse2dense(moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return moments


def moments_away(base: Any) -> Array:
    """(nout, nv) moments of actuators ``AWAY`` from the file's own pose, where they might vanish."""
    data = mujoco.MjData(base)
    data.qpos[:] += AWAY
    return _moments(base, data)


def moments_at(base: Any, joints: Sequence[str], positions: Array) -> Array:
    """(nout, nv) greatest size of the moments of actuators in some poses [m or rad for each m or rad of a dof].

    Args:
        base: MuJoCo's model.
        joints: names of all.
        positions: (n, nj) of them.
    """
    data, places = mujoco.MjData(base), [int(base.joint(name).qposadr[0]) for name in joints]
    greatest = np.zeros((base.nout, base.nv))
    for position in positions:
        data.qpos[places] = position
        greatest = np.maximum(greatest, np.abs(_moments(base, data)))
    return greatest


def _commands(base: Any, i: int, name: str, joints: Sequence[Axis], moment: Array) -> Iterator[Drive]:
    own = base.actuator(i).name
    named = f"{name}: actuator {own or i!r}"
    if not own:
        raise ModelError(f"{named} has no name, by which a recording's columns could be identified")
    _check(base, i, named)
    holds = int(base.actuator_history[i, 0]) * float(base.opt.timestep)
    if base.actuator_delay[i] > holds * (1 + 1e-9):
        raise ModelError(
            f"{named} has a delay of {base.actuator_delay[i]:g} s, and a buffer (nsample) that holds {holds:g} s of "
            "commands, expected as much as the delay at least"
        )
    dynamics = int(base.actuator_dyntype[i])
    at_joint = int(base.actuator_trntype[i]) in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    if at_joint:
        axis = next(a for a in joints if a.index == int(base.actuator_trnid[i, 0]))
    else:
        axis = max(joints, key=lambda a: abs(moment[a.dof]))
    state = int(base.actuator_actadr[i]) if dynamics in (*FILTERS, MUSCLE) else None
    inputs = [word for bit, word in INPUTS.items() if int(base.actuator_ctrlspec[i]) & bit]
    first, count = int(base.actuator_ctrladr[i]), int(base.actuator_ctrlnum[i])
    for n in range(count):
        limited = bool(base.actuator_ctrllimited[first + n])
        low, high = (float(v) for v in base.actuator_ctrlrange[first + n]) if limited else (-math.inf, math.inf)
        kind = inputs[n] if int(base.actuator_gaintype[i]) in OWN else ""
        servo, unit = _kind(base, i, axis, at_joint, kind)
        label = own if count == 1 else f"{own}.{kind}"
        yield Drive(label, i, axis.name, servo, unit, (low, high), state, first + n, own, at_joint, dynamics == MUSCLE)


def _check(base: Any, i: int, named: str) -> None:
    """Raise ModelError for an actuator that neither engine takes."""
    for array, taken, what in (
        (base.actuator_trntype, _TRANSMISSIONS, "transmission"),
        (base.actuator_gaintype, _GAINS, "gain"),
        (base.actuator_biastype, _BIASES, "bias"),
        (base.actuator_dyntype, _DYNAMICS, "dynamics"),
    ):
        if int(array[i]) not in {int(kind) for kind in taken}:
            kind = type(taken[0])(int(array[i])).name.partition("_")[2].lower()
            raise ModelError(f"{named} has the {what} {kind!r}, which neither engine takes; expected {TAKEN}")
    gain, bias = mujoco.mjtGain(int(base.actuator_gaintype[i])), mujoco.mjtBias(int(base.actuator_biastype[i]))
    muscles = gain == mujoco.mjtGain.mjGAIN_MUSCLE, bias == mujoco.mjtBias.mjBIAS_MUSCLE
    if any(muscles) and not all(muscles) and bias != mujoco.mjtBias.mjBIAS_NONE:
        gains, biases = (kind.name.partition("_")[2].lower() for kind in (gain, bias))
        raise ModelError(
            f"{named} has the gain {gains!r} and the bias {biases!r}, which neither engine takes; expected both of a "
            "muscle, or neither"
        )
    if base.actuator_plugin[i] >= 0:
        raise ModelError(f"{named} is a plugin, which neither engine takes; expected {TAKEN}")


def _kind(base: Any, i: int, axis: Axis, at_joint: bool, given: str) -> tuple[bool, str]:
    """Whether a command is a goal for where something is, and its unit."""
    position_unit, force_unit = ("m", "N") if axis.slides else ("rad", "N·m")
    if given:
        unit = {"pos": position_unit, "vel": f"{position_unit}/s", "ff": force_unit, "voltage": "V"}[given]
        return given == "pos", unit if at_joint or given == "voltage" else "1"
    bias = base.actuator_biasprm[i]
    affine = int(base.actuator_biastype[i]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    servo = bool(affine and bias[1] != 0)
    if not at_joint or int(base.actuator_gaintype[i]) != int(mujoco.mjtGain.mjGAIN_FIXED):
        return servo, "1"
    if int(base.actuator_dyntype[i]) == int(mujoco.mjtDyn.mjDYN_INTEGRATOR):
        return servo, f"{position_unit}/s" if servo else "1"
    # What a gain or a gear multiplies is a control signal.
    plain = not affine and base.actuator_gainprm[i, 0] == 1 and abs(base.actuator_gear[i, 0]) == 1
    unit = position_unit if servo else force_unit if plain else "1"
    return servo, f"{position_unit}/s" if affine and not servo and bias[2] != 0 else unit


def drive_parameters(base: Any, drives: Sequence[Drive]) -> list[ModelParameter]:
    """Numbers of actuators, each once."""
    found: list[ModelParameter] = []
    for drive in {drive.actuator: drive for drive in reversed(drives)}.values():
        slides = int(base.jnt_type[base.joint(drive.joint).id]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
        force_unit, position_unit = ("N", "m") if slides else ("N·m", "rad")
        own = drive.actuator
        found += _law_of(base, drive.index)(base, drive, force_unit, position_unit)
        if drive.activates:
            for key, entry in (("activation_time", 0), ("deactivation_time", 1)):
                write, value = (
                    setter("actuator", own, "actuator_dynprm", entry),
                    base.actuator_dynprm[drive.index, entry],
                )
                found.append(ModelParameter(f"{own}.{key}", float(value), "s", write))
        elif drive.state is not None:
            write = setter("actuator", own, "actuator_dynprm", 0)
            found.append(
                ModelParameter(f"{own}.time_constant", float(base.actuator_dynprm[drive.index, 0]), "s", write)
            )
        if base.actuator_delay[drive.index] > 0:
            write = setter("actuator", own, "actuator_delay")
            found.append(ModelParameter(f"{own}.delay", float(base.actuator_delay[drive.index]), "s", write))
        bounds = base.actuator_forcerange[drive.index]
        if base.actuator_forcelimited[drive.index] and math.isclose(*np.abs(bounds)):

            def limit(model: Any, value: float, name: str = own) -> None:
                model.actuator_forcerange[model.actuator(name).id] = -value, value

            found.append(ModelParameter(f"{own}.force_limit", float(bounds[1]), force_unit, limit))
    order = [drive.actuator for drive in drives]
    return sorted(found, key=lambda number: order.index(number.name.rpartition(".")[0]))


def _law_of(base: Any, i: int) -> Callable[[Any, Drive, str, str], Iterator[ModelParameter]]:
    gain = int(base.actuator_gaintype[i])
    return _own_law if gain in OWN else _peak_force if is_muscle(base, i) else _gain_and_bias


def is_muscle(model: Any, i: int) -> bool:
    """Whether an actuator's force is MuJoCo's force of a muscle, by its length and how fast that changes."""
    return int(model.actuator_gaintype[i]) == int(mujoco.mjtGain.mjGAIN_MUSCLE)


def peak_force(model: Any, i: int) -> float:
    """A muscle's greatest force, before the gear: where the file gives none, its scale over MuJoCo's ``acc0``."""
    force, scale = (float(value) for value in model.actuator_gainprm[i, 2:4])
    return force if force >= 0 else scale / max(float(model.actuator_acc0[i]), LEAST)


def hold_peak_forces(model: Any, base: Any) -> None:
    """Let muscles be as strong as in the file: by ``acc0`` MuJoCo would make those stronger whose load is heavier.

    Args:
        model: a ``mujoco.MjModel``, changed in place.
        base: of the file.
    """
    for i in range(base.nactuator):
        if is_muscle(base, i):
            k = model.actuator(base.actuator(i).name).id
            model.actuator_gainprm[k, 2] = model.actuator_biasprm[k, 2] = peak_force(base, i)


def _peak_force(base: Any, drive: Drive, force_unit: str, position_unit: str) -> Iterator[ModelParameter]:
    own = drive.actuator

    def write(model: Any, value: float) -> None:
        i = model.actuator(own).id
        model.actuator_gainprm[i, 2] = model.actuator_biasprm[i, 2] = value

    yield ModelParameter(f"{own}.force", peak_force(base, drive.index), "N", write)


def _gain_and_bias(base: Any, drive: Drive, force_unit: str, position_unit: str) -> Iterator[ModelParameter]:
    i, own = drive.index, drive.actuator
    gain, bias = float(base.actuator_gainprm[i, 0]), base.actuator_biasprm[i]
    follows = not drive.servo and bias[2] != 0 and math.isclose(float(bias[2]), -gain)
    if drive.servo and math.isclose(float(bias[1]), -gain):

        def stiff(model: Any, value: float) -> None:
            k = model.actuator(own).id
            model.actuator_gainprm[k, 0], model.actuator_biasprm[k, 1] = value, -value

        yield ModelParameter(f"{own}.kp", gain, f"{force_unit}/{position_unit}", stiff)
    elif follows:

        def follow(model: Any, value: float) -> None:
            k = model.actuator(own).id
            model.actuator_gainprm[k, 0], model.actuator_biasprm[k, 2] = value, -value

        yield ModelParameter(f"{own}.kv", gain, f"{force_unit}·s/{position_unit}", follow)
    elif int(base.actuator_gaintype[i]) == int(mujoco.mjtGain.mjGAIN_FIXED):
        per_command = f"{force_unit}/{drive.unit}"
        unit = force_unit if drive.unit == "1" else "1" if drive.unit == force_unit else per_command
        yield ModelParameter(f"{own}.gain", gain, unit, setter("actuator", own, "actuator_gainprm", 0))
    if not follows and (bias[2] != 0 or drive.servo):
        yield _negative(base, drive, "kv", "actuator_biasprm", 2, f"{force_unit}·s/{position_unit}")


def _own_law(base: Any, drive: Drive, force_unit: str, position_unit: str) -> Iterator[ModelParameter]:
    i, own = drive.index, drive.actuator
    stiffness, damping = f"{force_unit}/{position_unit}", f"{force_unit}·s/{position_unit}"
    if int(base.actuator_gaintype[i]) == int(mujoco.mjtGain.mjGAIN_PID):
        yield _negative(base, drive, "kp", "actuator_biasprm", 1, stiffness)
        yield _negative(base, drive, "kv", "actuator_biasprm", 2, damping)
        entries = [("ki", 0, f"{force_unit}/({position_unit}·s)")]
    else:
        entries = [("resistance", 0, "Ω"), ("motorconst", 1, f"{force_unit}/A"), ("kp", 4, stiffness)]
        entries += [("ki", 5, f"{force_unit}/({position_unit}·s)"), ("kd", 6, damping), ("voltage_limit", 7, "V")]
    for key, entry, unit in entries:
        value = float(base.actuator_gainprm[i, entry])
        if value > 0:
            yield ModelParameter(f"{own}.{key}", value, unit, setter("actuator", own, "actuator_gainprm", entry))


def _negative(base: Any, drive: Drive, key: str, array: str, entry: int, unit: str) -> ModelParameter:
    """A number that stands in MuJoCo's array with the other sign."""

    def write(model: Any, value: float) -> None:
        getattr(model, array)[model.actuator(drive.actuator).id, entry] = -value

    return ModelParameter(f"{drive.actuator}.{key}", 0.0 - float(getattr(base, array)[drive.index, entry]), unit, write)


def exerts_its_command(base: Any, drive: Drive) -> bool:
    """Whether an actuator's force is its command, filtered or not, times a gain."""
    i = drive.index
    gain, bias, dynamics = (
        int(kinds[i]) for kinds in (base.actuator_gaintype, base.actuator_biastype, base.actuator_dyntype)
    )
    plain = gain == int(mujoco.mjtGain.mjGAIN_FIXED) and bias == int(mujoco.mjtBias.mjBIAS_NONE)
    return plain and dynamics in (int(mujoco.mjtDyn.mjDYN_NONE), *FILTERS)


def scale_force(model: Any, actuator: str, factor: float) -> None:
    """Make an actuator's force, a gain and a bias, so many times as large."""
    i = model.actuator(actuator).id
    entries = slice(2, 3) if is_muscle(model, i) else slice(0, 3)
    model.actuator_gainprm[i, entries] *= factor
    model.actuator_biasprm[i, entries] *= factor


def limit_force(model: Any, actuator: str, size: float) -> None:
    """Limit an actuator's force to a size [N·m or N], or what it is limited to where that is less."""
    i = model.actuator(actuator).id
    own = (-size, size)
    if model.actuator_forcelimited[i]:
        own = max(-size, model.actuator_forcerange[i, 0]), min(size, model.actuator_forcerange[i, 1])
    model.actuator_forcelimited[i] = 1
    model.actuator_forcerange[i] = own
