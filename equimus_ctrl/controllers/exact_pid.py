"""PID on the joints of any robot, its efforts turned into commands by the exact equations of motion.

The law is that of ``controllers.pid_kernel``. What it computes with is taken where the robot is to be, not where it is
measured: with τ = B u + τ₀ of ``models.dynamics``,

    u = B⁺(r) (τ(r, ṙ, r̈) − τ₀(r, ṙ) + w)

so that a servo, whose command is a goal, keeps its own feedback about a goal that w moves. Decoupled, w is the mass
matrix there times what the PIDs give (computed torque; Siciliano et al., *Robotics*, 2009, chapter 8). Of a motion that
the actuators cannot do, as of a step of the reference, as much is fed forward as they can do; the rest of it the
proportional and the derivative part do not see, so that it is the integral's (I-PD; Åström & Hägglund, *Advanced PID
Control*, 2006, chapter 5). What limits take away of w, of commands or of forces, goes back to the integral.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.controllers.inverse import Inverse, InverseState
from equimus_ctrl.controllers.pid_kernel import (
    DERIVATIVE,
    FILTER,
    INTEGRAL,
    KD,
    KI,
    KP,
    PREVIOUS,
    TRACKING,
    WEIGHT_D,
    WEIGHT_P,
)
from equimus_ctrl.controllers.pid_settings import PidSettings
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference, frozen_array


@dataclass(frozen=True, eq=False)
class ExactPidState:
    """What it carries from step to step.

    Attributes:
        settings: with gains.
        memory: (3, nj) integral, filtered derivative, previous weighted error.
        gains: (7, nj).
        begun: time of the first observation [s].
        dynamics: of what is known.
        inverse: of the same, with valves and sensors.
        followed: how far that has followed the reference.
        dt: control period [s].
        driven: (nj,) joints on which an actuator acts.
        reach: (na,) by how much what commands ask for can change from one command to the next.
        possible: of the instants from ``SMOOTHING`` before now on, what share of the motion can be done.
        shown: (nj,) reference of the measurement before.
        note: where the gains come from; empty where somebody gave them.
    """

    settings: PidSettings
    memory: Array
    gains: Array
    begun: float
    dynamics: Dynamics
    inverse: Inverse
    followed: InverseState
    dt: float
    driven: NDArray[np.bool_]
    reach: Array
    shown: Array
    possible: tuple[float, ...] = ()
    note: str = ""


def begin(settings: PidSettings, spec: PlantSpec, observation: Observation, dynamics: Dynamics) -> ExactPidState:
    """The state whose first command is the one in force.

    Args:
        settings: with gains for each joint.
        spec: of the plant.
        observation: the first.
        dynamics: of what is known of the robot.
    """
    s, y = settings, np.array(observation.position)
    inverse = Inverse(Model(spec.model, spec.effects, spec.phase), spec.control_dt, s.start_time)
    followed = inverse.start(observation.time, y)
    gains = s.gain_matrix(spec.joints)
    still = np.zeros_like(y)
    fed = _fed(s, dynamics, followed.pose)
    driven = np.any(dynamics.authority(followed.pose, still)[0] != 0, axis=1)
    effort = dynamics.exerted(y, still, observation.command) - dynamics.exerted(y, still, fed)
    if s.decoupled:
        effort = np.linalg.pinv(dynamics.effective_mass(y, driven)) @ effort
    memory = np.zeros((3, len(y)))
    memory[INTEGRAL] = effort - gains[KP] * (gains[WEIGHT_P] - 1.0) * y
    memory[PREVIOUS] = (gains[WEIGHT_D] - 1.0) * y
    dt, reach = spec.control_dt, spec.command_rate * spec.control_dt
    return ExactPidState(s, memory, gains, observation.time, dynamics, inverse, followed, dt, driven, reach, y)


def step(observation: Observation, reference: Reference, state: ExactPidState) -> tuple[Array, ExactPidState]:
    """The next command within the plant's limits, and the next state."""
    s, gains, dt, inverse, dynamics = state.settings, state.gains, state.dt, state.inverse, state.dynamics
    now, measured = observation.time, max(observation.stamp, state.begun)
    shown, planned, followed = inverse.follow(reference, np.array([now]), np.array([measured]), state.followed)
    q, v, _ = (x[:, 0] for x in inverse.motion(reference, np.array([now + dt / 2]), state.followed))
    # A step is differentiated to a motion there and back, of which half may be possible.
    possible = inverse.possible(reference, now, state.followed, state.possible, now=True)
    share, still = min(possible), _fed(s, dynamics, q)
    fed = still + share * (planned[0] - still) if s.inverse else still
    r, y = shown[0], np.array(observation.position)
    memory = state.memory.copy()
    # What the actuators cannot do of the reference's motion is seen by the integral alone.
    unseen = np.where(gains[KI] > 0, (1 - share) * (r - state.shown), 0.0)
    memory[INTEGRAL] -= gains[KP] * gains[WEIGHT_P] * unseen
    weighted = gains[WEIGHT_D] * r - y
    slope = (weighted - memory[PREVIOUS] - gains[WEIGHT_D] * unseen) / dt
    memory[DERIVATIVE] += dt / (gains[FILTER] + dt) * (slope - memory[DERIVATIVE])
    memory[PREVIOUS] = weighted
    effort = gains[KP] * (gains[WEIGHT_P] * r - y) + memory[INTEGRAL] + gains[KD] * memory[DERIVATIVE]
    weight = dynamics.effective_mass(q, state.driven) if s.decoupled else np.eye(len(y))
    # As far as a command gets until the next; that of before is within the limits.
    low = np.maximum(inverse.low, observation.command - state.reach)
    high = np.minimum(inverse.high, observation.command + state.reach)
    low, high = np.minimum(low, inverse.high), np.maximum(high, inverse.low)
    # What limits take away of the feed-forward alone is none of the integral's business.
    fed = np.clip(fed, low, high)
    asked = fed + dynamics.answer(dynamics.authority(q, v)[0], weight @ effort)
    # Which actuators limits of forces stop is told by where the robot is.
    command = dynamics.shared(y, v, asked, dynamics.exerted(y, v, fed) + weight @ effort, low, high)
    ends = low, high
    lost = np.linalg.pinv(weight) @ (
        _lost(dynamics, y, v, asked, command, ends) - _lost(dynamics, q, v, fed, fed, ends)
    )
    back = np.where(gains[TRACKING] > 0, np.minimum(dt / np.where(gains[TRACKING] > 0, gains[TRACKING], 1.0), 1.0), 1.0)
    memory[INTEGRAL] += np.where(gains[KI] > 0, dt * gains[KI] * (r - y) + back * lost, 0.0)
    return frozen_array(command), replace(state, memory=memory, followed=followed, possible=possible, shown=r)


def _lost(dynamics: Dynamics, q: Array, v: Array, asked: Array, command: Array, ends: tuple[Array, Array]) -> Array:
    """(nj,) what is exerted under a command less what would be, without limits, under the one asked for.

    What a limit takes from one actuator's feedback of its own, as a servo's, counts where no other could exert it.
    """
    drive, own = dynamics.authority(q, v)
    wanted = drive @ asked + own
    return np.asarray(dynamics.exerted(q, v, dynamics.shared(q, v, command, wanted, *ends)) - wanted)


def _fed(settings: PidSettings, dynamics: Dynamics, q: Array) -> Array:
    """(na,) what is fed forward of a pose: what holds it at rest, or exerts nothing there."""
    still = np.zeros_like(q)
    torque = dynamics.needed(q, still, still) if settings.feedforward else still
    return dynamics.commands(q, still, torque)
