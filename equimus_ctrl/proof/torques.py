"""What torque a model lacks along measured motions, from smoothed derivatives: no simulation, no free parameters.

    r(model) = M(q) a + h(q, v) − Jᵀ (area·P + F) − T − friction

with q, v, a from a Savitzky–Golay filter on the measured angles, and P what the model's valves make of the commands,
through the same filter. A model that is right has r = 0 but for noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.command import pressure_history
from equimus_ctrl.effects.force import ForceEffect, force_laws
from equimus_ctrl.effects.sensors import OFFSET, PLAY, SCALE, SENSOR_DELAY, sensor_settings
from equimus_ctrl.effects.valves import shaped_commands, valve_settings
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.augmented import Laws, augmented_model, law_parameters
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.robots.elastic.morphology import Phase, pack, structure
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.types import Array

WINDOW = 0.17
"""Of the filter [s]."""
ORDER = 3
"""Of its polynomials."""
THIN = 4
"""Every so many samples are used; the filter makes neighbours alike."""
CLEAR = 0.02
"""Angle from a modelled stop within which noise would be multiplied by the stop's stiffness [rad]."""
TURN = {"joint": 0.05, "actuator": 0.005}
"""Rates over which dry friction turns [rad/s, m/s]."""


@dataclass(frozen=True, eq=False)
class Smooth:
    """One trial on an even grid.

    Attributes:
        segment: what was measured.
        time: (n,) [s].
        window: samples of the filter.
        position: (n, nj) as measured, smoothed [rad].
        velocity: (n, nj) [rad/s].
        acceleration: (n, nj) [rad/s²].
    """

    segment: Segment
    time: Array
    window: int
    position: Array
    velocity: Array
    acceleration: Array

    @classmethod
    def of(cls, segment: Segment) -> Smooth:
        """A segment's angles, derived twice."""
        times = segment.trial.sample_times
        step = float(np.median(np.diff(times)))
        grid = np.arange(times[0], times[-1], step)
        even = np.column_stack([np.interp(grid, times, column) for column in segment.measured.T])
        window = max(2 * round(WINDOW / step / 2) + 1, ORDER + 2)
        position = smoothed(even, window)
        velocity = np.gradient(position, step, axis=0)
        return cls(segment, grid, window, position, velocity, np.gradient(velocity, step, axis=0))

    @property
    def step(self) -> float:
        """Of the grid [s]."""
        return float(self.time[1] - self.time[0])

    def used(self, model: Model) -> NDArray[np.intp]:
        """(k,) indices of instants that are used: not where the filter lacks one side or a joint is at its stop."""
        low, high = model.morphology.joint_range
        at_stop = ((self.position < low + CLEAR) | (self.position > high - CLEAR)).any(axis=1)
        touched = np.convolve(at_stop, np.ones(2 * (self.window // 2) + 1), "same") > 0
        inner = np.zeros(len(self.time), dtype=bool)
        inner[self.window : -self.window : THIN] = True
        return np.flatnonzero(inner & ~touched)

    def pressure(self, model: Model) -> Array:
        """(n, na) behind the model's valves, through the filter [Pa]."""
        trial, names = self.segment.trial, model.morphology.actuator_names
        shaped = shaped_commands(model.effects, names, np.vstack([trial.before, trial.commands]))
        out = np.empty((len(self.time), 2, len(names)))
        start = float(self.time[0]) - self.step / 2
        pressure_history(
            np.array(trial.times), shaped[1:].copy(), shaped[0].copy(), valve_settings(model.effects, names), start,
            self.step, out,
        )  # fmt: skip
        return smoothed(out[:, 0], self.window)

    def motion(self, model: Model) -> tuple[Array, Array, Array]:
        """(n, nj) angles, velocities and accelerations of the joints behind the model's sensors; play is left in."""
        found = [self.position.copy(), self.velocity.copy(), self.acceleration.copy()]
        for j, sensor in enumerate(sensor_settings(model.effects, model.morphology.joint_names)):
            found[0][:, j] -= sensor[OFFSET]
            for values in found:
                values[:, j] = np.interp(self.time + sensor[SENSOR_DELAY], self.time, values[:, j]) / sensor[SCALE]
        return found[0], found[1], found[2]


def smoothed(values: Array, window: int) -> Array:
    """(n, k) columns through the filter, twice: all that is compared passes through the same."""
    once = savgol_filter(values, window, ORDER, axis=0)
    return np.asarray(savgol_filter(once, window, ORDER, axis=0))


def has_play(model: Model) -> bool:
    """Whether a sensor has play, behind which no motion can be seen."""
    return bool(sensor_settings(model.effects, model.morphology.joint_names)[:, PLAY].any())


@lru_cache(maxsize=8)
def _functions(form: Structure, phase: Phase, laws: Laws) -> tuple[ca.Function, ca.Function, ca.Function]:
    """(q, v, a, z, P, p) → missing torque; (z, q, v, p, dt) → z one step on; (q, p) → z at rest."""
    m, base = augmented_model(form, phase, laws), build(form, phase)
    turns = ca.vertcat(*[TURN[kind] for kind, _ in m.rubbing], ca.DM(0, 1))
    rubbed = -m.bound_here * ca.tanh(m.rows / turns)
    a, dt = ca.SX.sym("a", m.v.numel()), ca.SX.sym("dt")
    mass = ca.substitute(base.mass, base.p, m.p[: base.p.numel()])
    missing = mass @ (a - ca.substitute(m.acceleration, m.phi, rubbed))
    slope = ca.SX.eye(m.z.numel()) - dt * ca.jacobian(m.z_rate, m.z)
    moved = m.z + dt * ca.solve(slope, m.z_rate) if m.z.numel() else m.z
    return (
        ca.Function("missing", [m.q, m.v, a, m.z, m.pressure, m.p], [missing]),
        ca.Function("moved", [m.z, m.q, m.v, m.p, dt], [moved]),
        ca.Function("rest", [m.q, m.p], [m.rest_state]),
    )


def missing_torque(model: Model, trials: Sequence[Smooth], instants: Sequence[NDArray[np.intp]]) -> list[Array]:
    """For each trial (k, nj) the torque that a model lacks at some instants (k,), see ``Smooth.used`` [N·m]."""
    robot = changed_bodies(model.effects, model.morphology)
    laws, form = force_laws(), structure(robot)
    missing, moved, rest = _functions(form, model.phase, laws)
    force_effects = [e for e in model.effects if isinstance(e, ForceEffect)]
    slots = augmented_model(form, model.phase, laws).slots
    parameters = np.array(
        [*pack(robot), *law_parameters(slots, force_effects, robot.joint_names, robot.actuator_names)]
    )
    remembers = any(e.n_states for e in force_effects)
    found = []
    for trial, used in zip(trials, instants, strict=True):
        q, v, a = trial.motion(model)
        states = np.zeros((len(q), moved.size1_in(0)))
        if remembers:
            first = rest(q[0], parameters)
            along = moved.mapaccum(len(q) - 1)(first, q[1:].T, v[1:].T, parameters, trial.step)
            states = np.vstack([np.array(first).T, np.array(along).T])
        rows = [x[used].T for x in (q, v, a, states, trial.pressure(model))]
        found.append(np.array(missing(*rows, parameters)).T)
    return found
