"""The robots a controller must work on: a model with its parameters spread, behind drives that are late."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.effects.base import Effect, require_simulated
from equimus_ctrl.effects.bodies import BodyEffect, changed_bodies
from equimus_ctrl.effects.command import DELAY, FILL, POWER, VENT
from equimus_ctrl.effects.valves import FirstOrderLag, TransportDelay, ValveEffect, valve_settings
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.spread import Group, groups, latin_hypercube, perturbed
from equimus_ctrl.robots.elastic.morphology import VARYING, Morphology, Phase, pack
from equimus_ctrl.tuning.study import EnsembleSettings
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class Member:
    """One leg of an ensemble.

    Attributes:
        name: for tables.
        morphology: its parameters.
        parameters: the same as a vector.
        valve: (na, 6), see ``effects.valves``.
        effects: all others; what changes bodies stands in the morphology already.
    """

    name: str
    morphology: Morphology
    parameters: Array
    valve: Array
    effects: tuple[Effect, ...] = ()

    def model(self, phase: Phase) -> Model:
        """The leg with its effects, without valves."""
        return Model(self.morphology, self.effects, phase)

    def rest(self, command: Array, phase: Phase) -> Array:
        """(nj,) where it rests under constant commands [rad]."""
        return rest_pose(self.model(phase), command)


def make_ensemble(model: Model, settings: EnsembleSettings, count: int, seed: int, fixed: bool = True) -> list[Member]:
    """``count`` legs around a model, drawn by a Latin hypercube so that few of them cover the ranges.

    Args:
        model: at the centre of the ranges.
        settings: how far the parameters spread.
        count: how many.
        seed: the same seed gives the same legs.
        fixed: whether the first is the model itself with valves at the centre of their ranges and the second the leg
            that is hardest to stabilise: longest delays, most force, least stiffness, damping and mass.

    Raises:
        ConfigError: where an effect is of no kind known here.
    """
    require_simulated(model.effects, f"{model.name}: the tuning loop")
    m = changed_bodies(model.effects, model.morphology)
    spreads = groups(m, {key: getattr(settings, key) for key in (*VARYING, "mass")})
    na = len(m.actuators)
    rows = _rows(spreads, 2 * na, count, seed, fixed)
    labels = ["model", "hardest"][: count if fixed else 0]
    own = valve_settings(model.effects, m.actuator_names)
    has_own = any(isinstance(effect, ValveEffect) for effect in model.effects)
    others = tuple(effect for effect in model.effects if not isinstance(effect, (ValveEffect, BodyEffect)))
    members = []
    for k, row in enumerate(rows):
        by_actuator = row[len(spreads) :].reshape(na, 2)
        if has_own:
            valve = own * (1 + settings.valve_spread * (2 * by_actuator[:, [0, 1, 1, 1, 1, 1]] - 1))
            valve[:, POWER] = own[:, POWER]
        else:
            delay = settings.delay[0] + by_actuator[:, 0] * (settings.delay[1] - settings.delay[0])
            lag = settings.lag[0] + by_actuator[:, 1] * (settings.lag[1] - settings.lag[0])
            unlimited = np.full(na, np.inf)
            valve = np.stack([delay, lag, lag, unlimited, unlimited, np.zeros(na)], axis=1)
        changed = perturbed(m, spreads, row[: len(spreads)])
        members.append(Member(labels[k] if k < len(labels) else f"leg {k}", changed, pack(changed), valve, others))
    return members


def most_lateness(model: Model, settings: EnsembleSettings, led: bool) -> float:
    """By how much later the commands of ``make_ensemble``'s legs act than a controller leads them, at most [s].

    Args:
        model: at the centre.
        settings: of the ensemble.
        led: whether the controller leads what the model knows of its valves.
    """
    if not any(isinstance(effect, ValveEffect) for effect in model.effects):
        return settings.delay[1] + settings.lag[1]
    own = valve_settings(model.effects, model.morphology.actuator_names)
    own = own[:, DELAY] + (own[:, FILL] + own[:, VENT]) / 2
    return float(own.max()) * (settings.valve_spread if led else 1 + settings.valve_spread)


def make_members(model: Model, settings: EnsembleSettings, count: int, seed: int, fixed: bool = True) -> list[Model]:
    """Robots of any kind around a model, drawn by a Latin hypercube; commands are later than the model says.

    Args:
        model: at the centre.
        settings: how far its numbers spread; dead times add to those it has, lags stand where it has none.
        count: how many.
        seed: the same seed gives the same robots.
        fixed: as of ``make_ensemble``; where lags spread, the third is the second with the shortest lags behind the
            longest dead times. A lag also weakens what it delays, a dead time only delays: a loop that asks for more
            at high frequencies than it can have is caught by the one and not by the other.

    Raises:
        ConfigError: where an effect is of no kind known here.
    """
    require_simulated(model.effects, f"{model.name}: the tuning loop")
    robot = changed_bodies(model.effects, model.robot)
    spreads = groups(robot, {key: getattr(settings, key) for key in (*VARYING, "mass")})
    names, slow = robot.actuator_names, _lagging(model)
    kept = [effect for effect in model.effects if not isinstance(effect, BodyEffect)]
    corners = ((1.0, 1.0), (1.0, 0.0))[: hardest(model, settings)]
    members = []
    for row in _rows(spreads, 2 * len(names), count, seed, fixed, corners):
        late = row[len(spreads) :].reshape(len(names), 2)
        delays, lags = (
            (low + share * (high - low)).tolist()
            for share, (low, high) in zip(late.T, (settings.delay, settings.lag), strict=True)
        )
        own = Model(perturbed(robot, spreads, row[: len(spreads)]), tuple(kept), model.phase)
        lagging = [
            FirstOrderLag(name, lag) for name, lag in zip(names, lags, strict=True) if lag > 0 and name not in slow
        ]
        members.append(later(replace(own, effects=(*kept, *lagging)), delays))
    return members


def hardest(model: Model, settings: EnsembleSettings) -> int:
    """How many robots of ``make_members`` behind the first are there because they are hardest to keep stable."""
    spreading = settings.lag[1] > settings.lag[0] and set(model.robot.actuator_names) - _lagging(model)
    return 2 if spreading else 1


def _lagging(model: Model) -> set[str]:
    """Actuators whose lag the model knows."""
    return {own.location for own in model.effects if isinstance(own, ValveEffect) and own.exclusive == "lag"}


def later(model: Model, delays: float | Sequence[float]) -> Model:
    """A model whose commands are later by so much, one for all or one for each actuator [s]."""
    names = model.robot.actuator_names
    known = {effect.location: effect.delay for effect in model.effects if isinstance(effect, TransportDelay)}
    others = tuple(effect for effect in model.effects if not isinstance(effect, TransportDelay))
    more = np.broadcast_to(delays, len(names)).tolist()
    late = [TransportDelay(name, known.get(name, 0.0) + delay) for name, delay in zip(names, more, strict=True)]
    return Model(model.robot, (*others, *late), model.phase)


def _rows(
    spreads: Sequence[Group],
    late: int,
    count: int,
    seed: int,
    fixed: bool,
    corners: Sequence[tuple[float, float]] = ((1.0, 1.0),),
) -> list[Array]:
    """Places in the ranges of parameters and of what is late: the middle, what is hardest to stabilise, and drawn.

    Args:
        spreads: the parameters.
        late: how many dead times and lags there are, which take turns.
        count: of places.
        seed: of those drawn.
        fixed: whether the middle and the hardest are among them.
        corners: dead time and lag of what is hardest.
    """
    n = len(spreads) + late
    corner = [
        1.0 if names[0].endswith(".area") else 0.5 if names[0].endswith(".rest_length") else 0.0 for names, _ in spreads
    ]
    hardest = [np.array([*corner, *(own * (late // 2))]) for own in corners]
    known = [np.full(n, 0.5), *hardest][:count] if fixed else []
    return [*known, *latin_hypercube(count - len(known), n, np.random.default_rng(seed))]
