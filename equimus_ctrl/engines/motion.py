"""What moves inside one model in one trial: what no sensor shows, at the true joints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import casadi as ca
import numpy as np

from equimus_ctrl.effects.sensors import hermite
from equimus_ctrl.engines.batch import STEP, shaped_for
from equimus_ctrl.engines.encoding import Encoded, encode
from equimus_ctrl.engines.hidden import Commands, first_activations, lead, led_states, with_unknown
from equimus_ctrl.engines.limits import MAX_SPEED
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.robots.elastic.morphology import Phase
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.types import Array

hermite_arrays = cast("Callable[..., Array]", hermite.py_func)
"""``effects.sensors.hermite`` over whole arrays."""


@dataclass(frozen=True, eq=False)
class Inner:
    """The motion at n instants.

    Attributes:
        time: (n,) [s].
        position: (n, nj) of the true joints [rad or m].
        velocity: (n, nj) [rad/s or m/s].
        pressure: (n, na) what the actuators' forces are made of: pressures behind the valves [Pa], or commands as they
            arrive at drives [unit of the commands].
        length: (n, na) of the actuators [m], or of what they act along.
        rate: (n, na) its derivative.
        arm: (n, na, nj) ∂length/∂position.
        coordinates: (n, nv) of the equations of motion, of which joints may be some.
        rates: (n, nv) of those.
        state: (n, nz) the effects' states, as ``augmented_model`` with all laws has them.
    """

    time: Array
    position: Array
    velocity: Array
    pressure: Array
    length: Array
    rate: Array
    arm: Array
    coordinates: Array
    rates: Array
    state: Array


@dataclass(frozen=True, eq=False)
class Motion(Inner):
    """The motion at the m sample times of a trial.

    Attributes:
        name: of the trial.
        start: when the recording begins that the trial is a part of, with its first command [s].
        between: the motion in the middles of the m − 1 intervals between the samples, with the pressures' means over
            them, so that what is made of them counts a command's change by when it comes.
        coded: what moved, where compiled equations of motion moved it.
    """

    name: str
    start: float
    between: Inner
    coded: Encoded | None = None


def motion(model: Model, trial: Trial, start: Array | None = None, dt: float = STEP) -> Motion:
    """Follow a model through a trial.

    Args:
        model: what moves.
        trial: its commands, start and sample times.
        start: (nj,) joint positions or (2 nj,) positions and velocities at the start, in place of the trial's [rad or
            m, rad/s or m/s]; what else may begin anywhere may follow them, see ``engines.batch.simulate``.
        dt: physics step [s].

    Raises:
        ConfigError: where ``dt`` is no step or the trial has fewer than two samples.
        SimulationDiverged: where the simulation does.
    """
    if not 0 < dt < float("inf"):
        raise ConfigError(f"the physics step is {dt:g} s, expected more than 0")
    times = np.asarray(trial.sample_times)
    if len(times) < 2:
        raise ConfigError(f"{trial.name}: has {len(times)} samples, too few for a motion; expected at least 2")
    coded = encode([model], trial)
    own, lanes = coded.mechanics[0], coded.lanes
    nj, nv, na = len(own.joints), len(own.starts), len(own.channels)
    given = np.asarray(trial.position if start is None else start, dtype=np.float64)
    q0, v0 = given[:nj], np.zeros(nj) if trial.velocity is None else trial.velocity
    v0 = given[nj : 2 * nj] if len(given) > nj else v0
    known = 2 * (nj + model.robot.loose_count)
    q0, v0 = trial.begun(model.robot, q0, np.asarray(v0), given[2 * nj : known])
    steps = max(int(np.ceil((times[-1] - trial.start) / dt - 1e-9)), 1)
    states, pressures = np.empty((steps + 1, lanes.n_state)), np.empty((steps, 2, na))
    shaped = np.clip(shaped_for(model, trial), *coded.between[0])
    commands = Commands(shaped[None, 1:].copy(), shaped[:1].copy(), coded.valve, coded.follow)
    one = slice(0, 1)
    first, sensor = first_activations(coded, one, trial, q0[None]), coded.sensors_of_coordinates(one)
    led = lead(coded, one, [trial], commands, sensor, first[None], dt)
    q, v, linear = q0[None, own.starts].copy(), v0[None, own.starts].copy(), trial.lines(model.robot)
    at_start = np.array([trial.start]), q[None], v[None]
    hidden = led_states(lanes, coded.parameters, trial.times, commands, sensor, led, at_start, dt, linear)
    hidden = with_unknown(coded, one, hidden, given[None, None, known:])
    lanes.kernel.run_inner(
        lanes.robot,
        coded.parameters,
        trial.times,
        commands.commands,
        commands.before,
        coded.valve,
        coded.follow,
        first,
        q,
        v,
        coded.rubbing,
        trial.start,
        dt,
        states,
        pressures,
        linear,
        hidden,
    )
    if not np.all(np.abs(states[:, nv : 2 * nv]) < MAX_SPEED):
        raise SimulationDiverged(f"{trial.name}: the simulation of {model.name} diverged")
    grid = _Grid(coded, trial.start, dt, states, pressures)
    edges = grid.impulse(times)
    middles = (times[1:] + times[:-1]) / 2
    between = grid.at(middles, np.diff(edges, axis=0) / np.diff(times)[:, None])
    at = grid.at(times, grid.pressure(times))
    return Motion(**vars(at), name=trial.name, start=float(trial.times[0]), between=between, coded=coded)


@dataclass(frozen=True, eq=False)
class _Grid:
    """A motion on its physics steps.

    Attributes:
        coded: what moved.
        start: of the grid [s].
        dt: of the grid [s].
        states: (steps + 1, 2 nj + nz) positions, velocities and effect states.
        pressures: (steps, 2, na) mean and slope over each step of ``Inner.pressure``.
    """

    coded: Encoded
    start: float
    dt: float
    states: Array
    pressures: Array

    def _places(self, times: Array) -> tuple[Array, Array]:
        """Which step each instant lies in, and how far in it as a share of the step."""
        place = (times - self.start) / self.dt
        step = np.clip(place.astype(int), 0, len(self.pressures) - 1)
        return step, (place - step)[:, None]

    def pressure(self, times: Array) -> Array:
        """(n, na) ``Inner.pressure`` at some instants (n,) [s]."""
        step, share = self._places(times)
        mean, slope = self.pressures[step, 0], self.pressures[step, 1]
        return np.asarray(mean + (share - 0.5) * slope)

    def impulse(self, times: Array) -> Array:
        """(n, na) its integrals since the start."""
        step, share = self._places(times)
        mean, slope = self.pressures[step, 0], self.pressures[step, 1]
        before = np.vstack([np.zeros_like(mean[:1]), np.cumsum(self.pressures[:, 0], axis=0)])[step]
        return np.asarray(self.dt * (before + share * (mean + (share - 1) / 2 * slope)))

    def at(self, times: Array, pressure: Array) -> Inner:
        """The motion at some instants (n,) [s], with ``Inner.pressure`` (n, na)."""
        own = self.coded.mechanics[0]
        nv = len(own.starts)
        step, share = self._places(times)
        q, v, z = np.split(self.states, [nv, 2 * nv], axis=1)
        position = hermite_arrays(q[step], v[step], q[step + 1], v[step + 1], self.dt, share)
        velocity = v[step] + share * (v[step + 1] - v[step])
        state = z[step] + share * (z[step + 1] - z[step])
        geometry = _geometry(own.form, self.coded.models[0].phase)
        length, arm = (np.array(part) for part in geometry(position.T, own.parameters))
        arms = arm.reshape(len(arm), len(times), nv).transpose(1, 0, 2)
        rate = np.einsum("nav,nv->na", arms, velocity)
        # A drive that turns by itself stands for its joint.
        joint_arms = np.zeros((len(times), len(length), len(own.joints)))
        for k, joint in enumerate(own.starts):
            if joint < len(own.joints):
                joint_arms[:, :, joint] += arms[:, :, k]
        return Inner(
            np.array(times), position[:, own.joints], velocity[:, own.joints], pressure, length.T, rate, joint_arms,
            position, velocity, state,
        )  # fmt: skip


@lru_cache(maxsize=32)
def _geometry(form: Structure, phase: Phase) -> ca.Function:
    """(q, p) → lengths (na,) and moment arms (na, nv)."""
    m = build(form, phase)
    return ca.Function("geometry", [m.q, m.p], [m.lengths, m.jacobian])
