"""Models as the arrays that the reduced engine's kernels take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.effects.base import Effect, require_simulated
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.command import DELAY, FILL, FLOW, RATE, VENT
from equimus_ctrl.effects.following import DIRECT, FILTERED, FOLLOW_KIND, SLEWED
from equimus_ctrl.effects.force import all_laws_and, laws_with
from equimus_ctrl.effects.sensors import SCALE, sensor_settings
from equimus_ctrl.effects.valves import valve_settings
from equimus_ctrl.engines import lane_equations
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.augmented import Laws, law_parameters, rubbing_places, slots_of
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import RobotTraits
from equimus_ctrl.robots.mechanics import Mechanics, Structure
from equimus_ctrl.robots.mjcf.form import FAR
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class Encoded:
    """Models of one structure as the arrays that the kernels take.

    Attributes:
        models: (k) whose.
        laws: force laws that their equations have wherever they can sit.
        mechanics: (k) of their robots, with all effects on bodies.
        parameters: (k, np).
        valve: (k, na, 6), see ``effects.command.DELAY``; na with accelerations that are prescribed.
        follow: (k, na, 6), see ``effects.command.FOLLOW_KIND``.
        between: (k, 2, na) lowest and highest command that gets to the valves.
        sensor: (k, nj, 4), see ``effects.sensors.OFFSET``.
        rubbing: rows of dry friction in use.
    """

    models: Sequence[Model]
    laws: Laws
    mechanics: Sequence[Mechanics]
    parameters: Array
    valve: Array
    follow: Array
    between: Array
    sensor: Array
    rubbing: NDArray[np.int64]

    @property
    def form(self) -> Structure:
        """Of all of them."""
        return self.mechanics[0].form

    @property
    def lanes(self) -> lane_equations.Lanes:
        """The compiled equations of their form."""
        return lane_equations.load_lanes(self.form, self.models[0].phase, self.laws)

    def sensors_of_coordinates(self, rows: slice) -> Array:
        """(k, nv, 4) the sensors of some models' coordinates; those of coordinates that are no joints show them."""
        own, chosen = self.mechanics[0], self.sensor[rows]
        found = np.zeros((len(chosen), len(own.starts), 4))
        found[:, :, SCALE] = 1.0
        found[:, own.joints] = chosen
        return found


def encode(models: Sequence[Model], trial: Trial | None = None) -> Encoded:
    """The arrays of some models.

    Args:
        models: of one structure and phase.
        trial: in which some parameters are known to be others.

    Raises:
        ConfigError: where there is none, they differ in structure or phase, or an effect is of no kind known here.
    """
    if not models:
        raise ConfigError("no model was given to simulate")
    return encoded(models, [mechanics_of(model, trial) for model in models])


def encoded(models: Sequence[Model], mechanics: Sequence[Mechanics]) -> Encoded:
    """``encode`` with the models' mechanics, from ``mechanics_of``."""
    first, form = models[0], mechanics[0].form
    laws = laws_for([effect for model in models for effect in model.effects], first.robot.traits)
    slots, places = slots_of(form, laws), rubbing_places(form, laws)
    in_use: set[int] = set()
    rows, valves, follows, between, sensors = [], [], [], [], []
    for model, own in zip(models, mechanics, strict=True):
        if model.phase != first.phase or own.form != form:
            raise ConfigError(
                f"{model.name} and {first.name} differ in structure or phase, so they cannot run together"
            )
        require_simulated(model.effects, f"{model.name}: the reduced engine")
        for effect in model.effects:
            if effect.dry:
                in_use |= {
                    r for r, (kind, i) in enumerate(places) if own.law_places.get(kind, {i: ""})[i] == effect.location
                }
        in_use |= _own_friction(own, places)
        rows.append(
            np.concatenate(
                [
                    own.parameters,
                    law_parameters(slots, model.effects, own.law_places["joint"], own.law_places["actuator"]),
                ]
            )
        )
        valve, follow, counting = _channels(model, own)
        valves.append(valve)
        follows.append(follow)
        between.append(counting)
        sensors.append(sensor_settings(model.effects, model.robot.joint_names))
    return Encoded(
        models,
        laws,
        mechanics,
        np.array(rows),
        np.array(valves),
        np.array(follows),
        np.array(between),
        np.array(sensors),
        np.array(sorted(in_use), dtype=np.int64),
    )


def laws_for(effects: Sequence[Effect], traits: RobotTraits) -> Laws:
    """The force laws that compiled equations of a robot with some effects have, see ``keeps_states_of_laws``."""
    if traits.keeps_states_of_laws:
        return all_laws_and(effects, traits.catalogue)
    return laws_with(effects, traits.catalogue)


def mechanics_of(model: Model, trial: Trial | None) -> Mechanics:
    """Of a model's robot with all effects on bodies, and what is known to be another number in a trial."""
    robot = model.robot if trial is None else trial.robot_in(model.robot)
    return changed_bodies(model.effects, robot).mechanics()


def _own_friction(own: Mechanics, places: Sequence[tuple[str, int]]) -> set[int]:
    """Rows at which the robot itself has dry friction."""
    found = own.friction()
    return {r for r, place in enumerate(places) if found.get(place, 0.0) > 0}


def _channels(model: Model, own: Mechanics) -> tuple[Array, Array, Array]:
    """(na, 6) valves, (na, 6) what follows the commands behind them, and (2, na) between what commands get there.

    Accelerations of joints whose motion is prescribed count as commands, the last ones.
    """
    names = model.robot.actuator_names
    valve = np.vstack([valve_settings(model.effects, names), valve_settings((), model.robot.prescribed_names)])
    follow = np.zeros((len(own.channels), 6))
    between = np.empty((2, len(own.channels)))
    between[0], between[1] = -FAR, FAR
    for i, channel in enumerate(own.channels):
        valve[i, DELAY] += channel.delay
        follow[i] = channel.kind, channel.number, channel.low, channel.high, channel.least, channel.most
        if not (valve[i, FILL] == valve[i, VENT] == 0 and np.isinf(valve[i, [RATE, FLOW]]).all()):
            continue
        # Nothing is between the command and its bounds: they count by when a command changes within a step.
        between[:, i] = channel.low, channel.high
        if channel.kind == FILTERED and channel.least <= channel.low and channel.high <= channel.most:
            valve[i, FILL] = valve[i, VENT] = channel.number
            follow[i, FOLLOW_KIND] = DIRECT
        if channel.kind == SLEWED:
            valve[i, RATE] = channel.number
            follow[i, FOLLOW_KIND] = DIRECT
    return valve, follow, between


def grouped(models: Sequence[Model], trial: Trial) -> list[tuple[list[int], Encoded]]:
    """Models by their structure and laws: which, and their arrays."""
    groups: dict[tuple[Structure, str, Laws], list[int]] = {}
    known = {model: mechanics_of(model, trial) for model in dict.fromkeys(models)}
    mechanics = [known[model] for model in models]
    for i, (model, own) in enumerate(zip(models, mechanics, strict=True)):
        groups.setdefault((own.form, model.phase, laws_for(model.effects, model.robot.traits)), []).append(i)
    return [(g, encoded([models[i] for i in g], [mechanics[i] for i in g])) for g in groups.values()]
