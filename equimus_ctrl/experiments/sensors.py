"""What would tell rivals apart that no command does: another sensor, or a parameter made known.

The trial stays as it is, and one channel more is measured in it: a joint's velocity, a drive's force, the pressure in
an actuator. Each has noise of its own; where nobody says how much, ``SHARE`` of how far it goes, in the trial in which
it goes farthest, of a pressure of its whole range. Or a parameter that all rivals leave free is known to ``KNOWN`` of
its size. How far rivals are apart then is what ``separation`` says, to first order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.effects.command import pressure_history
from equimus_ctrl.effects.valves import shaped_commands, valve_settings
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.experiments.limits import Limits
from equimus_ctrl.experiments.predicted import Commands, as_noted, predicted_trials
from equimus_ctrl.experiments.separation import Separation, apart_in, with_channel
from equimus_ctrl.identification.channels import FORCE, VELOCITY, Channels
from equimus_ctrl.identification.noise import JointNoise
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

SHARE = 0.01
"""Of how far a channel goes in a trial, its noise where nobody says how much."""
KNOWN = 0.01
"""Of its size, how well a parameter is known that was made known."""
PRESSURE = "pressure."
"""What the names of channels begin with that are pressures in actuators, by the command of each."""

Kind = Literal["sensor", "parameter"]


@dataclass(frozen=True, eq=False)
class Remedy:
    """What would tell a pair of rivals apart.

    Attributes:
        kind: a sensor, or a parameter made known.
        name: ``vel.JOINT``, ``meas.ACTUATOR`` (a force), ``pressure.ACTUATOR``; or the parameter's.
        noise: of the sensor, or how well the parameter is known, standard deviations.
        unit: of that.
        pair: rivals that it tells apart.
        gap: −2Δln L by which one trial then favours the true one, the lesser of both ways round.
        without: the same as it is.
    """

    kind: Kind
    name: str
    noise: float
    unit: str
    pair: tuple[int, int]
    gap: float
    without: float

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {**vars(self), "pair": list(self.pair)}


def remedies(
    rivals: Rivals,
    trials: Mapping[tuple[int, int], Sequence[Commands]],
    limits: Limits,
    *,
    noises: Mapping[str, float] | None = None,
    simulator: Simulator | None = None,
) -> dict[tuple[int, int], tuple[Remedy, ...]]:
    """For each pair what tells it apart, best first.

    Args:
        rivals: of which some pairs are inseparable.
        trials: pair → those that may be made, of which the one counts that tells the most.
        limits: of commands.
        noises: channel → its standard deviation, where somebody knows it.
        simulator: that of the rivals by default.

    Raises:
        ConfigError: for a channel that the robot cannot have.
    """
    simulator = simulator or rivals.simulator()
    check_noises(rivals, noises or {})
    several = list({id(commands): commands for own in trials.values() for commands in own}.values())
    if not several:
        return {}
    cut = predicted_trials(rivals, rivals.rivals[0].model, several, simulator)
    sizes = {**_usual_noises(rivals, limits, cut, simulator), **(noises or {})}
    made = {
        id(commands): _with_each(rivals, commands, trial, sizes, simulator)
        for commands, trial in zip(several, cut, strict=True)
    }
    found: dict[tuple[int, int], tuple[Remedy, ...]] = {}
    for pair, own in trials.items():
        best: dict[str, Remedy] = {}
        for commands in own:
            (_, plain), *with_each = made[id(commands)]
            told = [replace(r, pair=pair, gap=_lesser(a, pair), without=_lesser(plain, pair)) for r, a in with_each]
            for one in (*told, *_made_known(rivals, plain, pair)):
                if one.name not in best or one.gap > best[one.name].gap:
                    best[one.name] = one
        found[pair] = tuple(sorted(best.values(), key=lambda own: -own.gap))
    return found


def check_noises(rivals: Rivals, noises: Mapping[str, float]) -> None:
    """Raise ConfigError for the noise of a channel that the robot cannot have."""
    known = channels_of_robot(rivals)
    for name in noises:
        if name not in known:
            raise ConfigError(unknown_name("sensor", name, known, rivals.model.name))


def channels_of_robot(rivals: Rivals) -> dict[str, str]:
    """Name → unit of the channels that the robot could have beside those that it has."""
    robot, have = rivals.model.robot, set(rivals.channels.names(rivals.model.robot))
    found = {VELOCITY + name: f"{unit}/s" for name, unit in zip(robot.joint_names, robot.joint_units, strict=True)}
    if robot.traits.commands_are_pressures:
        found |= {PRESSURE + name: "Pa" for name in robot.actuator_names}
    else:
        forces = Channels(forces=tuple(range(len(robot.actuator_names))))
        found |= dict(zip(forces.names(robot), forces.units(robot), strict=True))
    return {name: unit for name, unit in found.items() if name not in have}


def _usual_noises(
    rivals: Rivals, limits: Limits, trials: Sequence[Sequence[Segment]], simulator: Simulator
) -> dict[str, float]:
    """Channel → its noise where nobody says how much, see ``SHARE``."""
    found, truth = dict[str, float](), rivals.rivals[0].model
    for name in channels_of_robot(rivals):
        if name.startswith(PRESSURE):
            actuator = truth.robot.actuator_names.index(name.removeprefix(PRESSURE))
            found[name] = SHARE * float(limits.command_high[actuator] - limits.command_low[actuator])
            continue
        more = _more(rivals, name)
        goes = [_goes(truth, [_measuring(segment, more) for segment in own], name, simulator) for own in trials]
        found[name] = SHARE * (max(float(np.ptp(own)) for own in goes) or 1.0)
    return found


def _with_each(
    rivals: Rivals, commands: Commands, trial: Sequence[Segment], noises: Mapping[str, float], simulator: Simulator
) -> list[tuple[Remedy, Separation]]:
    """What there is without a further channel, then with each alone."""
    (plain,) = apart_in(rivals, [trial], 0, None, simulator)
    found = [(Remedy("sensor", "", 0.0, "", (0, 0), 0.0, 0.0), plain)]
    for name, unit in channels_of_robot(rivals).items():
        noise = noises[name]
        if name.startswith(PRESSURE):
            actuator = rivals.model.robot.actuator_names.index(name.removeprefix(PRESSURE))
            apart = with_channel(rivals, plain, _pressure_of(commands, rivals, actuator, noise), simulator)
        else:
            more = _more(rivals, name)
            seen = replace(rivals, channels=more, noise=_noise(rivals, more, name, noise))
            (apart,) = apart_in(seen, [[_measuring(segment, more) for segment in trial]], 0, None, simulator)
        found.append((Remedy("sensor", name, noise, unit, (0, 0), 0.0, 0.0), apart))
    return found


def _made_known(rivals: Rivals, apart: Separation, pair: tuple[int, int]) -> list[Remedy]:
    """Parameters of the model that both leave free, each known."""
    free = [rivals.rivals[k].parameters for k in pair]
    names = [[own.name for own in one.free] for one in free]
    of_model = rivals.model.robot.parameters()
    found = []
    for name in names[0]:
        if name not in names[1] or name not in of_model:
            continue
        at = [own.index(name) for own in names]
        sizes = [KNOWN * abs(float(of_model[name]) or one.scale[k]) for one, k in zip(free, at, strict=True)]
        more = apart
        for rival, k, size in zip(pair, at, sizes, strict=True):
            if rival == pair[0] or apart.places[rival] != apart.places[pair[0]]:  # what they share is known once
                more = _with_information(rivals, more, rival, k, size)
        unit = rivals.model.robot.unit(name)
        found.append(Remedy("parameter", name, sizes[0], unit, pair, _lesser(more, pair), _lesser(apart, pair)))
    return found


def _with_information(rivals: Rivals, apart: Separation, place: int, k: int, size: float) -> Separation:
    """The same where a rival's parameter is known to a standard deviation: its derivatives by what is then unknown."""
    rival = rivals.rivals[place]
    row = rival.spread[k] * rival.parameters.scale[k] / size  # of θ by z, over its standard deviation
    # In units of z, (I + rrᵀ)⁻¹ is the covariance then; its root turns derivatives by z.
    turn = np.linalg.cholesky(np.linalg.inv(np.eye(len(row)) + np.outer(row, row)))
    whole = np.eye(len(apart.gram))
    whole[apart.places[place], apart.places[place]] = turn
    return replace(apart, gram=whole.T @ apart.gram @ whole)


def _lesser(apart: Separation, pair: tuple[int, int]) -> float:
    return min(apart.gap(*pair), apart.gap(pair[1], pair[0]))


def _more(rivals: Rivals, name: str) -> Channels:
    """The channels with one more."""
    robot, own = rivals.model.robot, rivals.channels
    if name.startswith(VELOCITY):
        joint = robot.joint_names.index(name.removeprefix(VELOCITY))
        return replace(own, velocities=tuple(sorted((*own.velocities, joint))))
    actuator = robot.actuator_names.index(name.removeprefix(FORCE))
    return replace(own, forces=tuple(sorted((*own.forces, actuator))))


def _noise(rivals: Rivals, more: Channels, name: str, sigma: float) -> tuple[JointNoise, ...]:
    """Of each joint and channel, in their order."""
    robot = rivals.model.robot
    nj = len(robot.joint_names)
    had = dict(zip(rivals.channels.names(robot), rivals.noise[nj:], strict=True))
    return (*rivals.noise[:nj], *(had.get(own) or JointNoise(sigma) for own in more.names(robot)))


def _measuring(segment: Segment, more: Channels) -> Segment:
    trial = replace(segment.trial, inner=True, forces=bool(more.forces))
    return replace(segment, trial=trial, channels=more)


def _goes(truth: Model, wider: Sequence[Segment], name: str, simulator: Simulator) -> Array:
    """(n,) what a channel shows."""
    found = simulator([truth], wider, [segment.start[None] for segment in wider])
    place = wider[0].measured.shape[1] + wider[0].channels.names(truth.robot).index(name)
    return np.concatenate([own.position[0][:, place] for own in found])


def _pressure_of(commands: Commands, rivals: Rivals, actuator: int, noise: float) -> Callable[[Model], Array]:
    return lambda model: _pressure(model, commands, rivals, actuator) / noise


def _pressure(model: Model, commands: Commands, rivals: Rivals, actuator: int) -> Array:
    """(n,) mean pressure in an actuator from each sample to the next [Pa]."""
    here = as_noted(model, commands.notes)
    names, effects = here.robot.actuator_names, here.effects
    times, rows = commands.sampled(rivals.rate, rivals.linear)
    shaped = shaped_commands(effects, names, np.vstack([rows[:1], rows]), here.robot.command_ranges)
    out = np.empty((len(times), 2, len(names)))
    pressure_history(
        times, shaped[1:], shaped[0].copy(), valve_settings(effects, names), float(times[0]), 1 / rivals.rate, out
    )
    return np.asarray(out[:, 0, actuator])
