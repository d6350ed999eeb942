"""Experiment design: which experiment would distinguish what recordings could not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.results import Equivalent, Experiment, Finding, Named
from equimus_ctrl.diagnosis.search_state import SearchState
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
        commands: (n, na), in the unit of each actuator's command.
    """

    scenario: str
    settings: Mapping[str, float]
    times: Array
    commands: Array


Designs = Callable[[], Sequence[Design]]
"""Experiments to choose from, made where one is looked for."""


def separating(
    data: Data,
    end: SearchState,
    findings: Sequence[Finding],
    equivalent: Sequence[Sequence[Equivalent]],
    designs: Designs,
) -> Experiment | None:
    """The design in which the strongest finding that has an equivalent differs most from it; None where none has.

    The distance is √(Σ d²/n): d the difference of the two predictions, less what the second model's free parameters
    can undo to first order, over the standard deviation of the residuals that the search's end leaves at each joint.

    Args:
        data: what was measured.
        end: of the search.
        findings: strongest first.
        equivalent: for each part of the hypothesis what fits as well in its place, see ``findings.equivalents``.
        designs: to choose from.
    """
    pair = _pair(end, findings, equivalent)
    if pair is None:
        return None
    named, other = pair
    best: Experiment | None = None
    nj = len(data.free.model.robot.joint_names)
    sigma = np.array([noise.sigma for noise in white_noise(end.best.fit.residuals)[:nj]])
    for design in designs():
        distance = _distance(data, end.best, other.fitted, design, sigma)
        if best is None or distance > best.distance:
            best = Experiment(design.scenario, design.settings, (named, other.named), distance)
    return best


def _pair(
    end: SearchState, findings: Sequence[Finding], equivalent: Sequence[Sequence[Equivalent]]
) -> tuple[Named, Equivalent] | None:
    """The strongest finding that has an equivalent, and that."""
    for finding in findings:
        place = next(k for k, part in enumerate(end.best.hypothesis) if part in (finding.part, finding.law))
        if equivalent and equivalent[place]:
            return finding.named, equivalent[place][0]
    return None


def _distance(data: Data, first: Fitted, second: Fitted, design: Design, sigma: Array) -> float:
    """Root mean square distance of the predictions over the noise."""
    before = design.commands[0]
    start = Kinematics(second.fit.model.morphology, second.fit.model.phase).equilibrium(before)
    trial = Trial(design.scenario, design.times, design.commands, before, float(design.times[0]), start, design.times)
    shown = np.concatenate([start, np.zeros_like(start)])
    segment = Segment(trial, np.zeros((len(design.times), len(start))), 0, design.scenario, shown)
    free = second.fit.parameters
    moved = [second.fit.theta + STEP * free.scale * unit for unit in np.eye(len(free.free))]
    models = [second.fit.model, *(free.model_at(np.clip(theta, free.low, free.high)) for theta in moved)]
    (first_path,) = data.simulator([first.fit.model], [segment], [shown[None, :]])
    (varied,) = data.simulator(models, [segment], [np.tile(shown, (len(models), 1))])
    if not (first_path.sound.all() and varied.sound.all()):
        return 0.0
    noise = white_noise([np.ones((2, len(sigma))) * sigma])
    path = varied.position[0]
    difference = whiten(noise, design.times, first_path.position[0] - path).ravel()
    slopes = np.array([whiten(noise, design.times, p - path).ravel() for p in varied.position[1:]]).T
    distinct = Nuisance.of(slopes).project_out(difference)
    return float(np.sqrt((distinct**2).mean()))
