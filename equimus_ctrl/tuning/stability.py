"""The PID loop linearised: is the sampled loop stable, and with what margins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import expm

from equimus_ctrl.controllers.pid_kernel import FILTER, KD, KI, KP
from equimus_ctrl.controllers.pid_settings import PidSettings
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.command import DELAY
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.effects.sensors import SCALE, SENSOR_DELAY, behind, hermite, sensor_settings
from equimus_ctrl.effects.valves import ShapingEffect, command_for, shaped_commands
from equimus_ctrl.models.inverse import holding_pressure
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.linear import state_matrices, valve_lag, with_valves
from equimus_ctrl.models.spread import latin_hypercube
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase
from equimus_ctrl.tuning.ensemble import Member
from equimus_ctrl.types import Array

DOUBLINGS = 12
"""Of the periods over which a response is summed: 4096, in which a mode of modulus 0.998 dies away to 3·10⁻⁴."""
SLOPES = 64
"""At how many commands the steepest slope of what shaping leaves of them is looked for."""


@dataclass(frozen=True, eq=False)
class LinearLeg:
    """A leg about a pose, with its valves: d/dt x = A x + B S u(t − delay), z = C x in channel coordinates.

    A valve of two time constants is taken at their mean.
    C and the pose gain see the joint angles delayed by ``sensor_delay``.

    Attributes:
        a: (n, n) of joint angles, velocities and lagged pressures.
        b: (n, na).
        c: (nz, n).
        delay: (na,) [s].
        effort_map: (na, nz) pressures per channel effort, as the controller's nominal model has it.
        pose_gain: (na, n) pressures per change of pose that come from the map turning with the pose while an effort
            stands: none for lengths, and none where the nominal model is the leg's own.
        shaping: (na, na) S, what reaches the valves per command; all of it where it is None.
        sensor_delay: (nj,) dead time of each measured joint angle [s]; none where it is None.
        load: (n, na) of pressures at the actuators, as B has it of what reaches the valves; B itself where it is None.
    """

    a: Array
    b: Array
    c: Array
    delay: Array
    effort_map: Array
    pose_gain: Array
    shaping: Array | None = None
    sensor_delay: Array | None = None
    load: Array | None = None

    @property
    def joints(self) -> int:
        """How many; angles come first among the states, then as many velocities."""
        return int(np.flatnonzero(np.any((self.b if self.load is None else self.load) != 0, axis=1))[0])


def linear_legs(
    member: Member, nominal: Morphology, pose: Array, space: str, phase: Phase, fed: Array | None = None
) -> tuple[LinearLeg, ...]:
    """A member of an ensemble about a pose; twice where effects have states of their own: for quick and slow motion."""
    two = any(isinstance(effect, ForceEffect) and effect.n_states for effect in member.effects)
    return tuple(
        linear_leg(member, nominal, pose, space, phase, quick, fed) for quick in ((True, False) if two else (True,))
    )


def linear_leg(
    member: Member,
    nominal: Morphology,
    pose: Array,
    space: str,
    phase: Phase,
    quick: bool = True,
    fed: Array | None = None,
) -> LinearLeg:
    """Linearise a member of an ensemble about a pose it holds with its own static pressures.

    What is not linear counts as far as it can be: force effects by their slopes, commands by the steepest slope
    that shaping leaves of them. Dry friction, rate limits, filling flows, jumps and play are left to simulation.

    Args:
        member: the leg.
        nominal: what the controller computes with.
        pose: (nj,) that the controller sees [rad].
        space: of the channels.
        phase: base fixed or foot pinned.
        quick: see ``models.linear.state_matrices``.
        fed: (na,) fed forward there [Pa]; the static pressures by default.
    """
    known = Kinematics(nominal, phase)
    sensor = sensor_settings(member.effects, nominal.joint_names)
    # Pressing on a stop only slows a loop down: a pose beyond one is taken at its edge.
    true = np.clip(behind(sensor, pose), *member.morphology.joint_range)
    held = holding_pressure(member.model(phase), true)
    a, b = state_matrices(member.morphology, true, held, phase, member.effects, quick)
    n, na = b.shape
    jacobian = known.jacobian(pose)
    area = np.array([x.area for x in nominal.actuators])
    channel = jacobian if space == "length" else np.eye(n // 2)
    nj = n // 2

    def pressures_of(q: Array) -> Array:
        return np.asarray(np.linalg.pinv(known.jacobian(q).T * area))

    effort_map = np.diag(1 / area) if space == "length" else pressures_of(pose)
    turning = np.zeros((na, nj))
    if space == "joint":
        limits = nominal.command_low, nominal.command_high
        asked = command_for(member.effects, nominal.actuator_names, held[None], *limits)[0]
        standing = (jacobian.T * area) @ (asked - (known.static_pressure(pose) if fed is None else fed))
        for j, step in enumerate(1e-6 * np.eye(nj)):
            turning[:, j] = (pressures_of(pose + step) - pressures_of(pose - step)) @ standing / 2e-6
    c = np.hstack([channel * sensor[:, SCALE], np.zeros_like(channel)])
    full_a, full_b, slow = with_valves(a, b, valve_lag(member.valve))
    pose_gain = np.zeros((na, len(full_a)))
    pose_gain[:, :nj] = turning * sensor[:, SCALE]
    full_c = np.hstack([c, np.zeros((c.shape[0], len(slow)))])
    return LinearLeg(
        full_a,
        full_b,
        full_c,
        member.valve[:, DELAY],
        effort_map,
        pose_gain,
        _steepest(member.effects, nominal),
        sensor[:, SENSOR_DELAY] if np.any(sensor[:, SENSOR_DELAY] > 0) else None,
        np.vstack([b, np.zeros((len(slow), na))]),
    )


def _steepest(effects: Sequence[Effect], robot: Morphology) -> Array | None:
    """(na, na) the largest slope anywhere in the command range of what reaches each valve by each command."""
    if not any(isinstance(effect, ShapingEffect) for effect in effects):
        return None
    na, span = len(robot.actuators), robot.command_high - robot.command_low
    tried = robot.command_low + span * latin_hypercube(SLOPES, na, np.random.default_rng(0))
    found = np.zeros((na, na))
    here = shaped_commands(effects, robot.actuator_names, tried)
    for j, step in enumerate(1e-6 * span * np.eye(na)):
        up, down = (shaped_commands(effects, robot.actuator_names, tried + s * step) for s in (1, -1))
        ahead, behind = (up - here) / step[j], (here - down) / step[j]
        # A jump is on one side alone, and no slope.
        slopes = np.where(np.abs(ahead) < np.abs(behind), ahead, behind)
        found[:, j] = slopes[np.abs(slopes).argmax(axis=0), np.arange(na)]
    return found


def _held(a: Array, b: Array, dt: float) -> tuple[Array, Array]:
    """Exact discretisation of d/dt x = A x + B u with u held."""
    n, m = b.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = a * dt, b * dt
    exponential = expm(block)
    return exponential[:n, :n], exponential[:n, n:]


@dataclass(frozen=True, eq=False)
class SampledLeg:
    """A linear leg seen at the control instants, each command with a dead time of whole periods and a rest.

    Attributes:
        leg: linearised.
        dt: control period [s].
        phi: (n, n) state transition over one period.
        whole: (na,) whole periods of delay.
        newer: (n, na) effect of the command ``whole`` periods ago.
        older: (n, na) effect of the one before, which still acts for the rest of the delay.
        load: (n, na) effect of a pressure at each actuator beside what comes through its valve.
    """

    leg: LinearLeg
    dt: float
    phi: Array
    whole: tuple[int, ...]
    newer: Array
    older: Array
    load: Array


def sample(leg: LinearLeg, dt: float) -> SampledLeg:
    """Discretise a linear leg exactly for commands held over ``dt`` [s]."""
    whole = np.floor(leg.delay / dt + 1e-12).astype(int)
    newer, older = np.empty_like(leg.b), np.empty_like(leg.b)
    for i in range(leg.b.shape[1]):
        rest = leg.delay[i] - whole[i] * dt
        last_phi, last_gain = _held(leg.a, leg.b[:, [i]], dt - rest)
        newer[:, [i]] = last_gain
        older[:, [i]] = last_phi @ _held(leg.a, leg.b[:, [i]], rest)[1]
    phi, load = _held(leg.a, leg.b if leg.load is None else leg.load, dt)
    return SampledLeg(leg, dt, phi, tuple(int(w) for w in whole), newer, older, load)


def loop_matrix(sampled: SampledLeg, gains: Array) -> Array:
    """State matrix of the closed sampled loop: leg, valves, delayed commands and the PID's memory.

    Args:
        sampled: the leg.
        gains: (7, nz), see ``PidSettings.gain_matrix``.
    """
    leg, dt = sampled.leg, sampled.dt
    n, na = leg.b.shape
    nz = leg.c.shape[0]
    depth = max(sampled.whole) + 1
    sensor_delay = np.zeros(0) if leg.sensor_delay is None else leg.sensor_delay
    kept = math.ceil(sensor_delay.max(initial=0.0) / dt)
    # State: x, the last `depth` commands (newest first), angles and velocities at the last `kept` instants where a
    # sensor has a delay, integral, derivative, minus the previous measurement.
    i_past = n + depth * na
    size = i_past + kept * 2 * len(sensor_delay) + 3 * nz
    i_int, i_der, i_pre = (size - (3 - k) * nz for k in range(3))
    eye = np.eye(size)
    seen = _seen(sensor_delay / dt, dt, eye, n, i_past)
    z_row = leg.c @ seen
    alpha = (dt / (gains[FILTER] + dt))[:, None]
    derivative = (1 - alpha) * eye[i_der : i_der + nz] + alpha * (-z_row - eye[i_pre : i_pre + nz]) / dt
    effort = -gains[KP][:, None] * z_row + eye[i_int : i_int + nz] + gains[KD][:, None] * derivative
    command = leg.effort_map @ effort + leg.pose_gain @ seen  # (na, size)
    command = command if leg.shaping is None else leg.shaping @ command
    out = np.zeros((size, size))
    out[:n, :n] = sampled.phi
    history = [command] + [eye[n + k * na : n + (k + 1) * na] for k in range(depth)]
    for i, whole in enumerate(sampled.whole):
        out[:n] += sampled.newer[:, [i]] @ history[whole][[i]] + sampled.older[:, [i]] @ history[whole + 1][[i]]
    out[n : n + na] = command
    out[n + na : n + depth * na] = eye[n : n + (depth - 1) * na]
    remembered = [*range(2 * len(sensor_delay)), *range(i_past, i_int)][: i_int - i_past]
    out[i_past:i_int] = eye[remembered]
    out[i_int : i_int + nz] = eye[i_int : i_int + nz] - dt * gains[KI][:, None] * z_row
    out[i_der : i_der + nz] = derivative
    out[i_pre : i_pre + nz] = -z_row
    return out


def load_response(sampled: SampledLeg, gains: Array, load: Array) -> float:
    """How far a leg gives way to a load that sets in and stays, until its integrals have taken it up [rad √s].

    √(Σ |q|² dt) of the joint angles, root mean square over loads at each actuator alone. From the state x* that the
    loop settles in, the deviation dies away as −Mᵏ x*, of which the sum of squares is x*ᵀ S x* with S = CᵀC + Mᵀ S M,
    summed up by doubling (Smith, SIAM Journal on Applied Mathematics 16, 1968).

    Args:
        sampled: the leg; its loop is stable.
        gains: see ``loop_matrix``.
        load: (na,) [Pa].
    """
    matrix = loop_matrix(sampled, gains)
    size, (n, na), nj = len(matrix), sampled.load.shape, sampled.leg.joints
    acts = np.zeros((size, na))
    acts[:n] = sampled.load * load
    settled = np.linalg.solve(np.eye(size) - matrix, acts)
    total, power = np.zeros((size, size)), matrix
    total[np.arange(nj), np.arange(nj)] = 1.0
    for _ in range(DOUBLINGS):
        total = total + power.T @ total @ power
        power = power @ power
    return math.sqrt(max(sampled.dt * float(np.einsum("ki,kl,li->", settled, total, settled)) / na, 0.0))


def _seen(periods: Array, dt: float, eye: Array, n: int, first: int) -> Array:
    """(n, size) rows of x as its sensors show it: delayed angles lie on the cubic between two instants.

    Args:
        periods: (nj,) delay of each, in control periods.
        dt: control period [s].
        eye: (size, size) rows of the loop's state.
        n: size of x.
        first: where angles and velocities of the last instants begin in the loop's state, newest first.
    """
    seen, nj = eye[:n].copy(), len(periods)
    for j in np.flatnonzero(periods):
        older = math.ceil(periods[j])
        ends = [at if k == 0 else first + (k - 1) * 2 * nj + at for k in (older, older - 1) for at in (j, nj + j)]
        weights = np.array([hermite(q0, v0, q1, v1, dt, older - periods[j]) for q0, v0, q1, v1 in np.eye(4)])
        seen[j] = weights @ eye[ends]
    return seen


def largest_modulus(legs: Sequence[SampledLeg], gains: Array) -> float:
    """The largest |eigenvalue| of the closed sampled loop over all legs; below 1 is stable."""
    return max(float(np.abs(np.linalg.eigvals(loop_matrix(leg, gains))).max()) for leg in legs)


@dataclass(frozen=True)
class Margins:
    """Of one loop, broken at the command of one actuator with the others closed.

    Attributes:
        actuator: where the loop is broken.
        gain: factor by which its gain may rise before the loop is unstable.
        phase: by which its phase may fall [rad].
        delay: which may be added [s].
        crossover: gain crossover frequency [rad/s].
    """

    actuator: str
    gain: float
    phase: float
    delay: float
    crossover: float

    def to_dict(self) -> dict[str, Any]:
        """Plain types; infinite margins become None."""
        values = {
            "gain_margin": self.gain,
            "phase_margin_deg": math.degrees(self.phase),
            "delay_margin_s": self.delay,
            "crossover_rad_s": self.crossover,
        }
        return {"actuator": self.actuator} | {k: v if math.isfinite(v) else None for k, v in values.items()}


def loop_response(leg: LinearLeg, gains: Array, dt: float, omega: Array) -> Array:
    """(n_omega, na, na) loop transfer at the commands: hold, delay, leg, sampled PID; negative feedback."""
    s = 1j * omega[:, None, None]
    z = np.exp(s * dt)
    hold = (1 - 1 / z) / (s * dt)
    inputs = leg.b * np.exp(-s * leg.delay) * hold  # (n_omega, n, na)
    inputs = inputs if leg.shaping is None else inputs @ leg.shaping
    states = np.linalg.solve(s * np.eye(len(leg.a)) - leg.a, inputs)  # (n_omega, n, na)
    if leg.sensor_delay is not None:
        states[:, : len(leg.sensor_delay)] *= np.exp(-s * leg.sensor_delay[:, None])
    plant = leg.c @ states  # (n_omega, nz, na)
    alpha = (dt / (gains[FILTER] + dt))[:, None]
    derivative = alpha * (1 - 1 / z) / dt / (1 - (1 - alpha) / z)
    pid = gains[KP][:, None] + gains[KI][:, None] * dt / (z - 1) + gains[KD][:, None] * derivative  # (n_omega, nz, 1)
    return np.asarray(leg.effort_map @ (pid * plant) - leg.pose_gain @ states)


def margins(
    settings: PidSettings,
    member: Member,
    nominal: Morphology,
    pose: Array,
    dt: float,
    phase: Phase,
    fed: Array | None = None,
) -> list[Margins]:
    """Gain, phase and delay margin of each actuator's loop with the others closed (python-control).

    Only the feedback counts: what is fed forward depends on the reference, not on what is measured.
    """
    gains = settings.gain_matrix(settings.channels(nominal))
    legs = linear_legs(member, nominal, pose, settings.space, phase, fed)
    return least_margins([_margins(leg, gains, nominal.actuator_names, dt) for leg in legs])


def least_margins(found: Sequence[Sequence[Margins]]) -> list[Margins]:
    """The least of several loops' margins, actuator by actuator; the crossover is of the loop with the least delay."""
    least = []
    for own in zip(*found, strict=True):
        tightest = min(own, key=lambda m: m.delay)
        gain, phase = min(m.gain for m in own), min(m.phase for m in own)
        least.append(Margins(tightest.actuator, gain, phase, tightest.delay, tightest.crossover))
    return least


def _margins(leg: LinearLeg, gains: Array, actuators: Sequence[str], dt: float) -> list[Margins]:
    import control  # takes a second, and only this function needs it

    omega = np.geomspace(1e-2, math.pi / dt * 0.999, 800)
    loop = loop_response(leg, gains, dt, omega)
    found = []
    na = loop.shape[1]
    for i, actuator in enumerate(actuators):
        others = [j for j in range(na) if j != i]
        broken = loop[:, i, i].copy()
        if others:
            inner = np.eye(len(others)) + loop[:, others][:, :, others]
            broken -= np.einsum(
                "kj,kj->k", loop[:, i, others], np.linalg.solve(inner, loop[:, others, i][..., None])[..., 0]
            )
        response = control.frd(broken, omega, smooth=True)
        gains_at, phases, _, _, crossings, _ = control.stability_margins(response, returnall=True)
        rising = [float(g) for g in np.atleast_1d(gains_at) if g > 1]
        # Each crossover has its own phase to lose; the delay that loses it first is the margin.
        pairs = [(math.radians(p) % (2 * math.pi), float(w)) for p, w in zip(phases, crossings, strict=True)]
        tightest = min(pairs, key=lambda pair: pair[0] / pair[1], default=(math.inf, math.nan))
        found.append(
            Margins(
                actuator,
                min(rising, default=math.inf),
                min((p for p, _ in pairs), default=math.inf),
                min((p / w for p, w in pairs), default=math.inf),
                tightest[1],
            )
        )
    return found
