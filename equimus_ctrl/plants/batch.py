"""Many simulated robots in one process, each behind valves and sensors of its own: ``MujocoPlant`` times n."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from equimus_ctrl.computer import worker_count
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.effects.sensors import shown as seen_by
from equimus_ctrl.effects.valves import shaped_commands
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.mjcf import Scene
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.batch_group import Group, Moved, Unit
from equimus_ctrl.plants.batch_kernel import arrive, sense, shape_commands
from equimus_ctrl.plants.mujoco_plant import PlantRates, check_nominal, make_spec, rates_of, whole_ratio
from equimus_ctrl.types import Array, PlantSpec, Start

WHOLE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
"""All that a step depends on."""
Finish = Callable[[Any, Any], None]
"""Puts what stands around a robot into its place: (MuJoCo's model, its data), the robot being where it begins."""


@dataclass(frozen=True, eq=False)
class Step:
    """What the robots of one batch did in a control period.

    Attributes:
        group: the batch.
        rows: (r,) of which robots.
        moved: one row each.
    """

    group: Group
    rows: NDArray[np.int64]
    moved: Moved


class BatchPlant:
    """n robots in ``mujoco.batch``, alike in joints and actuators, else each with parameters and effects of its own.

    All see commands and measurements at one rate. Robots of one structure with the same laws beside MuJoCo share a
    batch. What a robot does depends on neither the number of threads nor the others, so one alone does the same.

    Args:
        n: how many.
        model: the nominal one, whose robot names joints and actuators.
        longest: control periods after which a robot has to begin anew, at most.
        control: commands and measurements a second [Hz]; as ``rates_of`` the robot by default.
        scene: adds what stands around a robot.
        integrator: see ``plants.body.body_of``.
        threads: to use; all usable processors by default.

    Raises:
        ConfigError: for a rate of which physics steps are no whole multiple.
    """

    def __init__(
        self,
        n: int,
        model: Model,
        longest: int,
        *,
        control: float | None = None,
        scene: Scene | None = None,
        integrator: str | None = None,
        threads: int | None = None,
    ) -> None:
        usual = rates_of(model.robot)
        self.rates = usual if control is None else PlantRates(control, control, usual.physics)
        self.n, self.model, self.longest = n, model, longest
        self._dt = 1 / self.rates.physics
        self.substeps = whole_ratio(self.rates.physics, self.rates.control, "physics rate over control rate")
        self._scene, self._integrator = scene, integrator
        self._threads = worker_count(threads, tasks=n, name="threads")
        self.spec: PlantSpec = make_spec(model.robot, 1 / self.rates.control, model, model.phase)
        nj, na = len(self.spec.joints), len(self.spec.actuators)
        self._groups: dict[Hashable, Group] = {}
        self._units: list[Unit | None] = [None] * n
        self._group_of: list[Group | None] = [None] * n
        self._times = np.arange(longest, dtype=np.float64) * self.spec.control_dt
        self._commands = np.zeros((n, na, longest))
        self._counts, self._steps = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
        self._before, self.pressure = np.zeros((n, na)), np.zeros((n, na))
        self._cursor = np.full((n, na), -1, dtype=np.int64)
        self._valve, self._sensor = np.zeros((n, na, 6)), np.zeros((n, nj, 4))
        self._shaping, self._shapers = np.zeros((n, 0, 3)), np.zeros(n, dtype=np.int64)
        self._by_python = np.zeros(n, dtype=bool)
        self._past = np.zeros((n, nj, math.ceil(_most_delay() / self._dt) + 3, 2))
        self._held = np.zeros((n, nj))
        self._starts: dict[Hashable, tuple[Array, Array, Array]] = {}
        self._shown: dict[int, tuple[Unit, Any]] = {}
        self.position, self.velocity, self.measured = np.zeros((3, n, nj))

    def prepare(self, model: Model) -> Unit:
        """A model of the same joints and actuators, ready for any row.

        Raises:
            ConfigError, ModelError: where it is of another robot, or cannot be simulated here.
        """
        check_nominal(self.model.robot, model.robot)
        return Unit.of(model, self._dt, self._scene, self._integrator)

    def unit(self, row: int) -> Unit:
        """Which robot stands in a row."""
        found = self._units[row]
        assert found is not None
        return found

    def group(self, row: int) -> Group:
        """Whose batch a row's robot is in."""
        found = self._group_of[row]
        assert found is not None
        return found

    def seen(self, row: int) -> tuple[Any, Any]:
        """MuJoCo's model and data of a row's robot as it is, for pictures; the model stays while the robot does."""
        unit, runs = self.unit(row), self.group(row).runs
        if self._shown.get(row, (None,))[0] is not unit:
            self._shown[row] = unit, runs.get_model(row)
        model = self._shown[row][1]
        data = runs.get_data(row)
        mujoco.mj_forward(model, data)
        return model, data

    def begin(self, row: int, unit: Unit, start: Start, finish: Finish | None = None) -> Array:
        """Put a robot into a row, at rest or as ``start`` says, at time 0.

        Args:
            row: the row.
            unit: which robot.
            start: see ``types.Start``.
            finish: puts what stands around it.

        Returns:
            (na,) the command that has been in force until now.

        Raises:
            ModelError: where the first command has no equilibrium.
        """
        body = unit.body
        command, reaches = self._placed(unit, start)
        position, velocity = np.array(body.data.qpos[body.qpos]), np.array(body.data.qvel[body.dof])
        if finish is not None:
            finish(body.mujoco_model, body.data)
        group = self._groups.get(unit.key)
        if group is None:
            group = self._groups[unit.key] = Group(unit, self.n, self._threads)
        group.put(row, unit)
        if group.laws is not None:
            group.laws.begin(row, body, position, velocity)
        self._units[row], self._group_of[row] = unit, group
        shaping = np.zeros((0, 3)) if unit.shaping is None else unit.shaping
        if len(shaping) > self._shaping.shape[1]:
            self._shaping = np.pad(self._shaping, ((0, 0), (0, len(shaping) - self._shaping.shape[1]), (0, 0)))
        self._shaping[row, : len(shaping)], self._shapers[row] = shaping, len(shaping)
        self._by_python[row] = unit.shaping is None
        self._valve[row], self._sensor[row] = body.valve, body.sensor
        self._counts[row] = self._steps[row] = 0
        self._before[row] = self.pressure[row] = reaches
        self._cursor[row] = -1
        self._past[row, :, 0, 0], self._past[row, :, 0, 1] = position, velocity
        self._held[row] = self.position[row] = position
        self.velocity[row] = velocity
        self.measured[row] = seen_by(body.sensor, position)
        return command

    def _placed(self, unit: Unit, start: Start) -> tuple[Array, Array]:
        """The commands (na,) in force before, and what arrives of them, the unit being put where it begins.

        What is known of a start is put back: to find where a robot rests takes as long as a hundred steps.
        """
        parts = (start.command, start.position, start.velocity)
        key = unit, tuple(None if part is None else part.tobytes() for part in parts)
        body = unit.body
        if key in self._starts:
            command, reaches, state = self._starts[key]
            mujoco.mj_setState(body.mujoco_model, body.data, state, WHOLE)
            return command, reaches
        command = np.asarray(body.command_before(start.position) if start.command is None else start.command)
        position = np.asarray(body.rest(start.command) if start.position is None else start.position)
        reaches = self._shaped_alone(unit, command)
        body.place(position, start.velocity, reaches)
        state = np.empty(mujoco.mj_stateSize(body.mujoco_model, WHOLE))
        mujoco.mj_getState(body.mujoco_model, body.data, state, WHOLE)
        self._starts[key] = command, reaches, state
        return command, reaches

    def _shaped_alone(self, unit: Unit, command: Array) -> Array:
        robot = unit.model.robot
        ranges = robot.command_ranges
        return np.array(shaped_commands(unit.model.effects, robot.actuator_names, command[None], ranges)[0])

    def step(self, rows: NDArray[np.int64], command: ArrayLike) -> list[Step]:
        """Hold commands for one control period; ``position``, ``velocity`` and ``measured`` are then those at its end.

        Args:
            rows: of which robots, ascending.
            command: (r, na); clipped to the range.

        Returns:
            What they did, batch by batch.

        Raises:
            ConfigError: where a robot was to begin anew before.
        """
        if np.any(self._counts[rows] >= self.longest):
            raise ConfigError(f"{self.model.name}: a robot is stepped for more than {self.longest} control periods")
        applied = np.clip(np.asarray(command, dtype=np.float64), self.spec.command_low, self.spec.command_high)
        reaches = np.empty(applied.shape)
        shape_commands(rows, self._shaping, self._shapers, applied, reaches)
        for r in np.flatnonzero(self._by_python[rows]):
            reaches[r] = self._shaped_alone(self.unit(rows[r]), applied[r])
        self._commands[rows, :, self._counts[rows]] = reaches
        self._counts[rows] += 1
        ctrl = np.empty((len(rows), self.substeps, applied.shape[1]))
        arrive(
            rows, self._times, self._commands, self._counts, self._before, self._cursor, self.pressure, self._valve,
            self._steps, self._dt, ctrl,
        )  # fmt: skip
        done = []
        for group, places in self._by_group(rows):
            own = rows[places]
            whole = np.zeros((len(own), self.substeps, group.base.nu))
            whole[:, :, group.control] = ctrl[places]
            moved = group.advance(own, whole)
            q, v = moved.qpos[:, :, group.qpos], moved.qvel[:, :, group.dof]
            shown = np.empty((len(own), q.shape[2]))
            sense(own, q, v, self._steps, self._sensor, self._past, self._held, self._dt, shown)
            good = own[moved.sound]
            self.position[good], self.velocity[good] = q[moved.sound, -1], v[moved.sound, -1]
            self.measured[good] = shown[moved.sound]
            done.append(Step(group, own, moved))
        return done

    def _by_group(self, rows: NDArray[np.int64]) -> Sequence[tuple[Group, NDArray[np.int64]]]:
        if len(self._groups) == 1:
            return [(next(iter(self._groups.values())), np.arange(len(rows)))]
        own = [self._group_of[row] for row in rows]
        found = ((g, np.flatnonzero([one is g for one in own])) for g in self._groups.values())
        return [(group, places) for group, places in found if len(places)]


def _most_delay() -> float:
    """The most that a sensor can be late [s]."""
    return float(REGISTRY["sensor_delay"].parameter_info()["delay"]["high"])
