"""A robot linearised about a pose at rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.command import FILL, VENT
from equimus_ctrl.effects.force import laws_of
from equimus_ctrl.effects.sensors import SCALE, sensor_settings
from equimus_ctrl.models.augmented import Laws, augmented_model, law_parameters, slots_of
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.elastic_equations import joint_stops, stops_in_mode
from equimus_ctrl.models.inverse import holding_pressure
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.solved import valves_of
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.models.symbolic_model import ldl_solve
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, pack, structure
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.types import Array, frozen_array

if TYPE_CHECKING:
    import control


@lru_cache(maxsize=32)
def _jacobians(form: Structure, phase: Phase) -> ca.Function:
    m = build(form, phase)
    a = m.acceleration
    parts = [ca.jacobian(a, m.q), ca.jacobian(a, m.v), ca.jacobian(a, m.f) @ ca.diag(m.area)]
    return ca.Function("linear", [m.q, m.v, m.f, m.tau, m.p], parts)


@lru_cache(maxsize=16)
def _jacobians_with_effects(form: Structure, phase: Phase, laws: Laws) -> tuple[ca.Function, ca.Function]:
    """(q, pressure, p) → ∂a/∂q, ∂a/∂v, ∂a/∂P at rest: the effects' states following quick motion, and slow motion."""
    m = augmented_model(form, phase, laws)
    by_q, by_v, by_p = (ca.jacobian(m.acceleration, x) for x in (m.q, m.v, m.pressure))
    by_z = ca.jacobian(m.acceleration, m.z)
    still = [m.v, m.phi, m.z], [ca.SX.zeros(m.v.shape), ca.SX.zeros(m.phi.shape), m.rest_state]
    found = []
    for name, follows in (("quick", ca.jacobian(m.z_rate, m.v)), ("slow", ca.jacobian(m.rest_state, m.q))):
        outputs = ca.substitute([by_q + by_z @ follows, by_v, by_p], *still)
        found.append(ca.Function(name, [m.q, m.pressure, m.p], outputs))
    return found[0], found[1]


def state_matrices(
    morphology: Morphology,
    pose: ArrayLike,
    pressure: ArrayLike,
    phase: Phase = "swing",
    effects: Sequence[Effect] = (),
    quick: bool = True,
) -> tuple[Array, Array]:
    """(A, B) of d/dt (q, v) = A (q, v) + B P about a pose at rest.

    Args:
        morphology: the robot.
        pose: (nj,) [rad].
        pressure: (na,) that holds it there [Pa].
        phase: base fixed or foot pinned.
        effects: those that are forces count, without dry friction; a law without a slope at rest counts as having none.
        quick: whether the effects' own states follow rates alone, as in quick motion; else they are as at rest.

    Returns:
        A (2nj, 2nj) and B (2nj, na).
    """
    nj, na = len(morphology.joints), len(morphology.actuators)
    at, given = np.asarray(pose, dtype=np.float64), np.asarray(pressure, dtype=np.float64)
    laws = laws_of(effects)
    form = structure(morphology)
    if laws:
        slots = slots_of(form, laws)
        parameters = law_parameters(slots, effects, morphology.joint_names, morphology.actuator_names)
        function = _jacobians_with_effects(form, phase, laws)[0 if quick else 1]
        found = function(at, given, np.append(pack(morphology), parameters))
        by_q, by_v, by_p = (np.where(np.isfinite(x), x, 0.0) for x in map(np.array, found))
    else:
        force, zero = np.array([a.area for a in morphology.actuators]) * given, np.zeros(nj)
        by_q, by_v, by_p = (np.array(x) for x in _jacobians(form, phase)(at, zero, force, zero, pack(morphology)))
    a = np.block([[np.zeros((nj, nj)), np.eye(nj)], [by_q, by_v]])
    b = np.vstack([np.zeros((nj, na)), by_p])
    return a, b


def with_valves(a: Array, b: Array, lag: Array) -> tuple[Array, Array, NDArray[np.intp]]:
    """(A, B) with the pressures behind lagging valves as further states, dP/dt = (u − P)/lag; others act at once.

    Args:
        a: (n, n).
        b: (n, na) of pressures.
        lag: (na,) time constants [s], 0 for none.

    Returns:
        A (n + k, n + k), B (n + k, na), and the actuators (k,) that the last k states belong to.
    """
    n, slow = len(a), np.flatnonzero(lag > 0)
    whole = np.zeros((n + len(slow), n + len(slow)))
    inputs = np.zeros((n + len(slow), b.shape[1]))
    whole[:n, :n], inputs[:n] = a, b
    for k, i in enumerate(slow):
        inputs[:n, i] = 0.0
        whole[:n, n + k] = b[:, i]
        whole[n + k, n + k] = -1 / lag[i]
        inputs[n + k, i] = 1 / lag[i]
    return whole, inputs, slow


def valve_lag(valve: Array) -> Array:
    """(na,) time constants of valves (na, 6), see ``effects.valves`` [s]; the mean where filling and venting differ."""
    return np.asarray((valve[:, FILL] + valve[:, VENT]) / 2)


About = Callable[[ArrayLike, ArrayLike | None], tuple[Array, Array]]
"""(pose, command or None for what holds it) → A and B of angles and velocities."""


def matrices_about(model: Model) -> About:
    """What gives (A, B) of a model about any pose at rest, see ``state_matrices`` and ``models.dynamics.Linear``.

    Raises:
        NotAvailable: where no equations hold the robot, or it has joints that are not measured.
    """
    if "lengths" not in model.robot.offers:
        dynamics = Dynamics(model)
        return lambda pose, command: dynamics.linear(pose, command).matrices()
    robot = changed_bodies(model.effects, model.morphology)

    def about(pose: ArrayLike, pressure: ArrayLike | None) -> tuple[Array, Array]:
        held = holding_pressure(model, pose) if pressure is None else np.asarray(pressure, dtype=np.float64)
        return state_matrices(robot, pose, held, model.phase, model.effects)

    return about


def linearise(
    model: Model, pose: ArrayLike, pressure: ArrayLike | None = None, about: About | None = None
) -> control.StateSpace:
    """A model about a pose at rest, as python-control takes it: from what reaches its valves to its angles.

    States are angles, velocities and the pressures behind valves with a lag, or commands behind filters, all as
    departures from rest. Delays of valves and sensors, dry friction, limited rates and play take no part; an elastic
    robot's effects with states of their own act as they do in quick motion, all other states are as at rest.

    Args:
        model: the robot with its effects.
        pose: (nj,) [rad].
        pressure: (na,) that holds it there [Pa]; by default the one that does, wherever it lies.
        about: ``matrices_about`` the model, where many poses are asked for.

    Returns:
        Continuous, its states called ``pos_hip``, ``vel_hip``, ``pressure_maa``, its inputs ``cmd_maa``, its outputs
        ``pos_hip`` as the sensors show them; python-control's names have no dots.

    Raises:
        NotAvailable: where no equations hold the robot, or it has joints that are not measured.
    """
    import control  # takes half a second, which most commands can do without

    a, b = (about or matrices_about(model))(pose, pressure)
    robot = changed_bodies(model.effects, model.robot)
    joints, actuators = ([name.replace(".", "_") for name in of] for of in (robot.joint_names, robot.actuator_names))
    a, b, slow = with_valves(a, b, valve_lag(valves_of(model)))
    c = np.zeros((len(joints), len(a)))
    c[:, : len(joints)] = np.diag(sensor_settings(model.effects, robot.joint_names)[:, SCALE])
    states = [f"{kind}_{name}" for kind in ("pos", "vel") for name in joints]
    return control.ss(
        a, b, c, np.zeros((len(joints), len(actuators))),
        states=[*states, *(f"pressure_{actuators[i]}" for i in slow)],
        inputs=[f"cmd_{name}" for name in actuators],
        outputs=[f"pos_{name}" for name in joints],
        name=robot.name,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Sampled:
    """A model about a pose at rest under held commands.

    Attributes:
        a: (n, n) of the states of ``linearise``, from one sample to the next.
        b: (n, na).
        authority: (nj, na) accelerations by what reaches the actuators.
    """

    a: Array
    b: Array
    authority: Array


_about = lru_cache(maxsize=64)(matrices_about)


@lru_cache(maxsize=4096)
def sampled(model: Model, pose: tuple[float, ...], dt: float) -> Sampled:
    """A model about the pose (nj,) [rad], sampled with dt [s]; what regulators with unlike settings share."""
    import control  # takes half a second, which most commands can do without

    nj, (a, b) = len(pose), _about(model)(pose, None)
    found = control.c2d(linearise(model, pose, about=lambda *_: (a, b)), dt)
    return Sampled(frozen_array(found.A), frozen_array(found.B), frozen_array(b[nj : 2 * nj]))


def fastest_rates(morphology: Morphology, pose: ArrayLike, phase: Phase = "swing") -> tuple[float, float]:
    """Largest |eigenvalue| of the motion about a pose [1/s]: away from the stops, and with one side's pressed.

    An explicit Runge–Kutta step dt of order four is stable where it is below 2.78/dt.

    Args:
        morphology: the robot, its actuators without drive.
        pose: (nj,) [rad].
        phase: base fixed or foot pinned.
    """
    found = _rate_jacobians(structure(morphology), phase)(np.asarray(pose, dtype=np.float64), pack(morphology))
    nj = len(morphology.joints)
    free, *pressed = (
        float(np.abs(np.linalg.eigvals(np.block([[np.zeros((nj, nj)), np.eye(nj)], [np.array(q), np.array(v)]]))).max())
        for q, v in zip(found[::2], found[1::2], strict=True)
    )
    return free, max(pressed)


@lru_cache(maxsize=32)
def _rate_jacobians(form: Structure, phase: Phase) -> ca.Function:
    """(q, p) → ∂a/∂q, ∂a/∂v at rest, with no stop, all lower ones and all upper ones pressed."""
    m = build(form, phase)
    nj = m.q.numel()
    free = ldl_solve(m.mass, -m.smooth_bias)
    outputs = []
    for pressed in ((0, 0), (1, 0), (0, 1)):
        torque = ca.vertcat(
            *[stops_in_mode(m.q[i], m.v[i], joint_stops(m.p, i), ca.SX(ca.DM(pressed)))[0] for i in range(nj)]
        )
        for x in (m.q, m.v):
            # How deep the stops are pressed does not matter here, only by what force they act.
            slope = ca.jacobian(torque, x)
            of_stops = ca.horzcat(*[ldl_solve(m.mass, slope[:, i]) for i in range(nj)])
            outputs.append(ca.substitute(ca.jacobian(free, x) + of_stops, m.v, ca.SX.zeros(m.v.shape)))
    return ca.Function("rates", [m.q, m.p], outputs)
