"""Many states of any robot one control period on: by the exact equations of motion in machine code, or in MuJoCo.

Both begin with what one state is made of and take all states at once, so that what a plan commands may depend on where
it leads. The exact equations take a Runge–Kutta step of order four, ends of joints included. They hold neither contacts
nor dry friction nor actuators with states of their own: a robot with one of these is rolled out in MuJoCo, on all
processors, with all that its XML has and its own integrator.
"""

from __future__ import annotations

import math
from typing import Any, Protocol

import casadi as ca
import mujoco
import numpy as np
from mujoco.rollout import Rollout

from equimus_ctrl.computer import processors
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.following import DIRECT
from equimus_ctrl.effects.force import force_effects, laws_of
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.engines.mjcf_realised import Realised, realise
from equimus_ctrl.engines.native import native
from equimus_ctrl.errors import ConfigError, NotAvailable
from equimus_ctrl.models.augmented import augmented_model, law_parameters
from equimus_ctrl.models.buffered import Buffered
from equimus_ctrl.models.model import Model
from equimus_ctrl.quiet import quietly
from equimus_ctrl.types import Array

ENGINES = ("auto", "exact", "mujoco")
LONGEST_STEP = 0.01
"""Of one Runge–Kutta step [s]: a joint that turns once a second is followed to 1e-6 of a turn."""


class Forward(Protocol):
    """A robot one control period on.

    Attributes:
        name: ``"exact"`` or ``"mujoco"``.
        why: it, a phrase.
    """

    name: str
    why: str

    def begin(self, q: Array, v: Array, arrived: Array) -> Array:
        """(nx,) a state: positions (nj,) [rad or m], rates (nj,), commands (na,) long in force."""
        ...

    def joints(self, states: Array) -> Array:
        """(…, 2 nj) positions and rates of states (…, nx)."""
        ...

    def placed(self, state: Array, q: Array, v: Array) -> Array:
        """(nx,) a state with other positions and rates (nj,)."""
        ...

    def __call__(self, states: Array, arriving: Array) -> Array:
        """(n, nx) states (n, nx) after a control period in which commands (n, na) act; NaN where one diverges."""
        ...


def slopes_of(forward: Forward, state: Array, arriving: Array, ahead: Array, beside: Array) -> Array:
    """(2 nj, 2 nj) slopes of positions and rates a control period on by those of a state, as differences of rollouts.

    Args:
        forward: the robot.
        state: (nx,) where it is.
        arriving: (na,) commands that act.
        ahead: (nx,) where that leads.
        beside: (2 nj,) by how much others begin beside it. One that diverges counts as a motion at the same rate.
    """
    x, nj = forward.joints(state), len(beside) // 2
    moved = x + np.diag(beside)
    begun = np.array([forward.placed(state, own[:nj], own[nj:]) for own in moved])
    after = forward.joints(forward(begun, np.tile(arriving, (2 * nj, 1)))) - forward.joints(ahead)
    return np.where(np.isfinite(after), after, np.diag(beside)).T / beside


def missing_in_exact(model: Model) -> str:
    """What the exact equations do not hold of a model that is rolled out, a phrase; empty where they hold all."""
    robot = changed_bodies(model.effects, model.robot)
    if "inverse" not in robot.offers:
        return f"its {robot.uninvertible[0]}"
    mechanics = robot.mechanics()
    states = augmented_model(mechanics.form, model.phase, laws_of(model.effects)).z.numel()
    if states or any(channel.kind != DIRECT for channel in mechanics.channels):
        return "states of its own beside its motion"
    if any(mechanics.friction().values()) or any(effect.dry for effect in force_effects(model.effects)):
        return "dry friction"
    return can_touch(realise(model).mujoco)


def can_touch(model: Any) -> str:
    """Which geoms of an ``MjModel`` may touch, a phrase; empty where none can."""
    if int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
        return ""
    kind, with_, body = model.geom_contype, model.geom_conaffinity, model.geom_bodyid
    weld, parent = model.body_weldid, model.body_parentid
    own = weld[body]
    above = weld[parent[own]]
    meets = (kind[:, None] & with_[None]) | (with_[:, None] & kind[None])
    # As MuJoCo has it: not within a body, and not with the parent unless that is the room.
    near = own[:, None] == own[None]
    if not int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
        near |= (above[:, None] == own[None]) & (own[None] > 0) | (own[:, None] == above[None]) & (own[:, None] > 0)
    pairs = np.argwhere((meets != 0) & ~near)
    if model.nexclude and len(pairs):  # by bodies, and of no pair that is named
        bodies = np.sort(body[pairs], axis=1).astype(np.int64)
        pairs = pairs[~np.isin((bodies[:, 0] << 16) + bodies[:, 1], model.exclude_signature)]
    if model.npair:
        pairs = np.concatenate([pairs, np.column_stack([model.pair_geom1, model.pair_geom2])])
    if not len(pairs):
        return ""
    first, second = (model.geom(int(g)).name or f"geom {int(g)}" for g in pairs[0])
    return f"contacts ({first} may touch {second})"


def make_forward(model: Model, samples: int, period: float, engine: str = "auto", compiled: bool = True) -> Forward:
    """The quicker of the two that holds all that a model has.

    Args:
        model: what is known of the robot.
        samples: how many states at once.
        period: of control [s].
        engine: of ``ENGINES``.
        compiled: whether a C compiler is used where there is one.

    Raises:
        ConfigError: where the engine does not hold something of the model.
    """
    missing = missing_in_exact(model)
    if engine == "exact" and missing:
        raise ConfigError(f"engine is 'exact', which does not hold {missing} of {model.name}; expected 'auto'")
    if engine == "mujoco" or missing:
        return MujocoForward(model, samples, period, f"it has {missing}" if missing else "it was asked for")
    return ExactForward(model, samples, period, compiled)


class ExactForward:
    """By the exact equations, see ``models.augmented``; a state is positions and rates.

    Args: as of ``make_forward``.
    """

    name = "exact"
    why = "it has neither contacts nor dry friction nor states of its own"

    def __init__(self, model: Model, samples: int, period: float, compiled: bool = True) -> None:
        robot = changed_bodies(model.effects, model.robot)
        mechanics, laws = robot.mechanics(), laws_of(model.effects)
        form = mechanics.form
        m = augmented_model(form, model.phase, laws)
        places = mechanics.law_places
        own = law_parameters(m.slots, model.effects, places["joint"], places["actuator"])
        nj, na = m.q.numel(), m.pressure.numel()
        low, high = (ca.DM([getattr(channel, side) for channel in mechanics.channels]) for side in ("low", "high"))
        given = ca.vertcat(m.p, m.phi), ca.vertcat(ca.DM([*mechanics.parameters, *own]), ca.DM.zeros(m.phi.shape))
        accelerations = ca.Function("accelerations", [m.q, m.v, m.pressure], [ca.substitute(m.acceleration, *given)])
        self._order = np.argsort(mechanics.joints)
        order, joints = self._order.tolist(), mechanics.joints.tolist()
        x, u = ca.SX.sym("x", 2 * nj), ca.SX.sym("u", na)
        clipped = ca.fmin(ca.fmax(u, low), high)

        def rate(y: ca.SX) -> ca.SX:
            q, v = y[:nj], y[nj:]
            return ca.vertcat(v, accelerations(q[order], v[order], clipped)[joints])

        parts = max(math.ceil(period / LONGEST_STEP - 1e-9), 1)
        y, h = x, period / parts
        for _ in range(parts):
            k1 = rate(y)
            k2 = rate(y + h / 2 * k1)
            k3 = rate(y + h / 2 * k2)
            k4 = rate(y + h * k3)
            y += h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        step = ca.Function("forward", [x, u], [ca.cse(ca.densify(y))])
        step = (native(step, "forward") if compiled else None) or step
        self._calls = {n: Buffered(step.map(n) if n > 1 else step) for n in (1, 2 * nj, samples)}

    def begin(self, q: Array, v: Array, arrived: Array) -> Array:
        return np.concatenate([q, v])

    def joints(self, states: Array) -> Array:
        return states

    def placed(self, state: Array, q: Array, v: Array) -> Array:
        return np.concatenate([q, v])

    def __call__(self, states: Array, arriving: Array) -> Array:
        call = self._calls[len(states)]
        call.arguments[0].reshape(states.shape)[:] = states
        call.arguments[1].reshape(arriving.shape)[:] = arriving
        call()
        return np.array(call.results[0].T.reshape(states.shape))


class MujocoForward:
    """In MuJoCo; a state is its full physics state, time first.

    Args: as of ``make_forward``, and why MuJoCo is taken.

    Raises:
        NotAvailable: for an effect that MuJoCo has no field for, or joints that are not measured.
    """

    name = "mujoco"

    def __init__(self, model: Model, samples: int, period: float, why: str) -> None:
        self.why = why
        own: Realised = realise(model)
        stepped = [effect for effect in force_effects(model.effects) if type(effect) in own.stepped]
        if stepped:
            raise NotAvailable(
                f"{model.name}: {stepped[0].name} at {stepped[0].location} is not simulated in many rollouts at once; "
                f"leave it out of what the controller knows, with --nominal"
            )
        if others := (*own.robot.prescribed_names, *own.robot.unmeasured_names):
            raise NotAvailable(
                f"{model.name}: the motion of {', '.join(others)} is not measured, expected all joints to be measured"
            )
        self._model = m = own.mujoco
        m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
        self._steps = max(round(period / m.opt.timestep), 1)
        m.opt.timestep = period / self._steps
        self._kind = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self._data = [mujoco.MjData(m) for _ in range(min(processors(), samples))]
        self._pool = Rollout(nthread=len(self._data) if len(self._data) > 1 else 0)
        self._robot = own.robot
        self._control = np.array([drive.control for drive in own.robot.actuators], dtype=np.int64)
        self._qpos = 1 + own.places[:, 0]
        self._qvel = 1 + m.nq + own.places[:, 1]
        # The physics state has the time first, then positions, rates and states of actuators.
        self._size = mujoco.mj_stateSize(m, self._kind)

    def begin(self, q: Array, v: Array, arrived: Array) -> Array:
        data, m = self._data[0], self._model
        mujoco.mj_resetData(m, data)
        data.qpos[self._qpos - 1], data.qvel[self._qvel - 1 - m.nq] = q, v
        for drive, settled in zip(self._robot.actuators, arrived.tolist(), strict=True):
            if drive.state is not None:
                data.act[drive.state] = min(max(settled, 0.0), 1.0) if drive.activates else settled
        state = np.empty(self._size)
        mujoco.mj_getState(m, data, state, self._kind)
        return state

    def joints(self, states: Array) -> Array:
        return np.concatenate([states[..., self._qpos], states[..., self._qvel]], axis=-1)

    def placed(self, state: Array, q: Array, v: Array) -> Array:
        found = state.copy()
        found[self._qpos], found[self._qvel] = q, v
        return found

    def __call__(self, states: Array, arriving: Array) -> Array:
        n, m = len(states), self._model
        lost = np.asarray(~np.isfinite(states).all(axis=1))
        given = np.where(lost[:, None], 0.0, states)
        given[:, 0] = 0.0
        control = np.zeros((n, 1, m.nu))
        control[:, 0, self._control] = arriving
        control = np.repeat(control, self._steps, axis=1)
        with quietly():
            found, _ = self._pool.rollout([m] * n, self._data, given, control)
        after = np.array(found[:, -1])
        # A rollout that MuJoCo gives up repeats its last state, and time stands still.
        lost |= after[:, 0] < (self._steps - 0.5) * m.opt.timestep
        lost |= ~(np.abs(after[:, self._qvel]) < MAX_SPEED).all(axis=1)
        after[lost] = np.nan
        return after
