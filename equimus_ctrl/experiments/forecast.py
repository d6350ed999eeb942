"""What a designed trial is expected to show: each rival's prediction, how sure it is, and what refitting leaves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.experiments.ground import Ground
from equimus_ctrl.experiments.power import INTERVAL
from equimus_ctrl.experiments.predicted import predicted_trials
from equimus_ctrl.experiments.refitting import Target, refitted
from equimus_ctrl.experiments.results import Designed
from equimus_ctrl.experiments.separation import apart_in
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.types import Array

DRAWS, COSTLY_DRAWS = 60, 8
"""Of each rival's parameters, of engines that take little and long."""


@dataclass(frozen=True, eq=False)
class Forecast:
    """Predictions of a trial.

    Attributes:
        times: (n,) [s].
        middle: (R, n, nj) what sensors show by each rival with its estimates [rad or m].
        low: (R, n, nj) and ``high`` ends of the interval that its parameters leave.
        high: see above.
        sigma: (nj,) standard deviation of the noise [rad or m].
        apart_times: (m,) [s].
        apart: other rival → (m, nj) what it leaves of the first one's prediction, refitted to it, over the noise.
    """

    times: Array
    middle: Array
    low: Array
    high: Array
    sigma: Array
    apart_times: Array
    apart: Mapping[int, Array]


def forecast(designed: Designed, simulator: Simulator | None = None) -> Forecast:
    """What is expected of a designed trial."""
    rivals, commands = designed.rivals, designed.commands
    simulator = simulator or rivals.simulator()
    ground = Ground(
        rivals, designed.limits, designed.condition, simulator, commands.course[0], commands.start,
        commands.law,
    )  # fmt: skip
    nj = len(rivals.model.robot.joint_names)
    rng = np.random.default_rng([designed.seed, 3])
    draws = COSTLY_DRAWS if simulator.engine.costly else DRAWS
    models = [rival.model for rival in rivals.rivals]
    for rival in rivals.rivals:
        models += [rival.model_at(theta) for theta in rival.draws(rng, draws)]
    crowd = ground.crowd(models)
    (found,) = crowd.predicted([commands])
    shown = np.full((len(models), *found.position.shape[1:-1], nj), np.nan)
    resting = {id(model) for model in crowd.models}
    there = [id(model) in resting for model in models]
    shown[there] = np.where(found.sound[:, None, None], found.position[..., :nj], np.nan)
    count = len(rivals.rivals)
    drawn = shown[count:].reshape(count, draws, *shown.shape[1:])
    low, high = np.nanquantile(drawn, INTERVAL, axis=1)
    first = rivals.rivals[0].model
    (segments,) = predicted_trials(rivals, first, [commands], simulator)
    (apart,) = apart_in(rivals, [segments], 0, None, simulator)
    target, left = Target.of(rivals, first, segments, simulator), dict[int, Array]()
    sigma = np.array([own.sigma for own in rivals.noise[:nj]])
    for k, rival in enumerate(rivals.rivals[1:], 1):
        led = rival.theta + rival.parameters.scale * (rival.spread @ apart.undone(0, k))
        left[k] = np.concatenate(refitted(rival, target, [led]).left)[:, :nj] / sigma
    times = np.concatenate([segment.trial.sample_times for segment in segments])
    return Forecast(commands.sampled(rivals.rate)[0], shown[:count], low, high, sigma, times, left)
