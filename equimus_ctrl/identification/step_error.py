"""What the error of the physics step does to a fit's parameters, counted into their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.fit import Fit
from equimus_ctrl.identification.noise import JointNoise, Noise
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.identification.uncertainty import UNSEEN
from equimus_ctrl.identification.whitened_fit import whiten_fit
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array


def with_step_error(
    fit: Fit,
    segments: Sequence[Segment],
    own: Simulator,
    other: Simulator,
    ratio: float,
    noise: Noise | None = None,
) -> Fit:
    """The fit with intervals as wide as noise and the discretisation error together can move its parameters.

    The error of a step h is C·h (MuJoCo's Euler and implicit integrators; of a higher order it is less), so predictions
    with a step of ``ratio``·h differ by C·h·(ratio − 1), and what parameters would make good of C·h is known from one
    simulation (Richardson, 1911). The robot itself has no step.

    Args:
        fit: of the segments, by ``own``.
        segments: what was fitted.
        own: the engine.
        other: the same with another step.
        ratio: of that step over its own.
        noise: that the fit was weighed by; none weighs all angles alike.
    """
    try:
        changes = changes_between(own, other, fit, segments)
    except SimulationDiverged:
        return fit
    times = [s.trial.sample_times for s in segments]
    whitened_fit = whiten_fit(times, fit, noise or tuple(map(JointNoise, segments[0].scales)))
    column = whitened_fit.columns(times, changes)[:, 0]
    moved = np.linalg.lstsq(whitened_fit.slopes, column, rcond=UNSEEN)[0] * fit.parameters.scale
    more = np.abs(moved) / abs(ratio - 1.0)
    return replace(
        fit,
        derive=lambda: fit.derivatives,
        known=cache(lambda: replace(fit.uncertainty, half_width=fit.uncertainty.half_width + more, step_error=more)),
    )


def step_error(fit: Fit) -> Array:
    """(nj + ne,) RMS error of the engine's physics step in a fit's predictions, parameters and starts as they are.

    0 where an engine's step does not count, see ``Engine.discretisation``; inf where a finer step diverges.
    """
    own, segments = fit.problem.simulator, fit.problem.segments
    if own.engine.discretisation is None:
        return np.zeros(fit.residuals[0].shape[1])
    try:
        changes = changes_between(own, replace(own, engine=own.engine.without_step_error()), fit, segments)
    except SimulationDiverged:
        return np.full(fit.residuals[0].shape[1], np.inf)
    return np.asarray(np.sqrt(np.mean(np.concatenate(changes)[..., 0] ** 2, axis=0)))


def changes_between(own: Simulator, other: Simulator, fit: Fit, segments: Sequence[Segment]) -> list[Array]:
    """For each segment (m, nj, 1) by how much a fit's predictions change from one engine to another.

    Raises:
        SimulationDiverged: where one of them diverges.
    """
    return changes_from(own, other, fit.model, segments, fit.starts)


def changes_from(
    own: Simulator, other: Simulator, model: Model, segments: Sequence[Segment], starts: Sequence[Array]
) -> list[Array]:
    """The same of a model from starts, see ``Segment.start``.

    Raises:
        SimulationDiverged: where one of them diverges.
    """
    rows = [start[None] for start in starts]
    before, after = (engine([model], segments, rows) for engine in (own, other))
    if not all(p.sound.all() for p in (*before, *after)):
        raise SimulationDiverged("the simulation diverged with another physics step or engine")
    return [np.moveaxis(b.position - a.position, 0, -1) for a, b in zip(before, after, strict=True)]
