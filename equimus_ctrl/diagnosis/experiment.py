"""Experiment design: which experiment would distinguish what recordings could not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis_moves import SearchState
from equimus_ctrl.diagnosis.results import Experiment, Finding, Named
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.noise import white_noise, whiten
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.types import Array

STEP = 1e-5
"""Of the differences, in units of each parameter's scale."""


@dataclass(frozen=True, eq=False)
class Design:
    """An experiment that could be made.

    Attributes:
        scenario: its name.
        settings: of the scenario, as they are given on the command line.
        times: (n,) from when each command holds [s].
        commands: (n, na) [Pa].
    """

    scenario: str
    settings: Mapping[str, float]
    times: Array
    commands: Array


Designs = Callable[[], Sequence[Design]]
"""Experiments to choose from, made where one is looked for."""


def separating(data: Data, found: SearchState, findings: Sequence[Finding], designs: Designs) -> Experiment | None:
    """The design in which the strongest finding that has an equivalent differs most from it.

    The distance is that of the two predictions after the second model's free parameters are refitted to the first, to
    first order; None where nothing is equivalent.
    """
    pair = _pair(found, findings)
    if pair is None:
        return None
    first, second, named = pair
    best: Experiment | None = None
    sigma = white_noise(found.best.fit.residuals)
    for design in designs():
        distance = _distance(data, first, second, design, np.array([s.sigma for s in sigma]))
        if best is None or distance > best.distance:
            best = Experiment(design.scenario, design.settings, named, distance)
    return best


def _pair(found: SearchState, findings: Sequence[Finding]) -> tuple[Fitted, Fitted, tuple[Named, Named]] | None:
    for finding in findings:
        for other in finding.equivalent:
            label = f"{other.effect}:{'+'.join(other.locations)}"
            for alternatives in found.alternatives:
                for alternative in alternatives:
                    if any(part.candidate.label == label for part in alternative.hypothesis):
                        return found.best, alternative, (finding.named, other)
    return None


def _distance(data: Data, first: Fitted, second: Fitted, design: Design, sigma: Array) -> float:
    """Root mean square distance of the predictions over the noise."""
    before = design.commands[0]
    start = Kinematics(second.fit.model.morphology, second.fit.model.phase).equilibrium(before)
    trial = Trial(design.scenario, design.times, design.commands, before, float(design.times[0]), start, design.times)
    shown = np.concatenate([start, np.zeros_like(start)])
    segment = Segment(trial, np.zeros((len(design.times), len(start))), 0, shown)
    free = second.fit.parameters
    moved = [second.fit.theta + STEP * free.scale * unit for unit in np.eye(len(free.free))]
    models = [second.fit.model, *(free.model_at(np.clip(theta, free.low, free.high)) for theta in moved)]
    (other,) = data.simulator([first.fit.model], [segment], [shown[None, :]])
    (own,) = data.simulator(models, [segment], [np.tile(shown, (len(models), 1))])
    if not (other.sound.all() and own.sound.all()):
        return 0.0
    noise = white_noise([np.ones((2, len(sigma))) * sigma])
    difference = whiten(noise, design.times, other.position[0] - own.position[0]).ravel()
    slopes = np.array([whiten(noise, design.times, p - own.position[0]).ravel() for p in own.position[1:]]).T
    left = Nuisance.of(slopes).project_out(difference)
    return float(np.sqrt((left**2).mean()))
