"""Unstructured residual forces: generalised forces along the motion that explain residuals without an effect."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl import computer
from equimus_ctrl.diagnosis.explained_variance import CUT, Explained, explained
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.force_basis import ForceFamily, batches, families, harmonics, responses
from equimus_ctrl.diagnosis.force_response import STEP, segment_response
from equimus_ctrl.diagnosis.observed import observed
from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.engines.base import ForceResponse
from equimus_ctrl.engines.motion import Motion
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.noise import Noise, whiten
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.whitened_fit import WhitenedFit, whiten_fit
from equimus_ctrl.types import Array

SLOWEST, FASTEST = 0.2, 4.0
"""Frequencies of a disturbance in time that are looked for [Hz]: slower ones a spline over time follows, faster ones
move a free joint by less than 1/400 of what the slowest does (it falls with the square of the frequency)."""
PERIOD_SAMPLES = 5
"""Samples in a period of the fastest, at least."""
LONGEST = 12.0
"""Frequencies are twice as close together as a recording of so long tells apart, at most [s]."""
FOLDS = 3
"""Of the cross-validation: of four trials three are fitted, and each of them can judge once."""
BOUND = 1e9
"""Responses [rad or m] above this, to a force of 1 N·m or N, are those of an instability."""


@dataclass(frozen=True, eq=False)
class ForceCandidate:
    """An unstructured residual force and what it explains.

    Attributes:
        family: where, and what it depends on.
        found: what it explains beside the free parameters.
    """

    family: ForceFamily
    found: Explained


@dataclass(frozen=True, eq=False)
class LinearisedFit:
    """A fitted hypothesis to first order, with all candidate residual forces, whitened by one noise.

    Attributes:
        fitted: the hypothesis.
        whitened_fit: residual and derivatives.
        families: the residual forces.
        columns: for each the whitened changes (N, k) of the measurements.
        folds: of the cross-validation: rows of shooting intervals that are held out together, or of whole trials where
            these are not cut; none where there is one alone.
        noise: by which they are whitened.
        motions: of the fitted model, trial by trial.
        price: of each coefficient of a residual force, in units of χ², where there are no folds, see
            ``Thresholds.residual_price_alone``.
        response: of what was measured to forces along the motions.
    """

    fitted: Fitted
    whitened_fit: WhitenedFit
    families: list[ForceFamily]
    columns: list[Array]
    folds: list[list[slice]]
    noise: Noise
    motions: list[Motion]
    price: float
    response: ForceResponse

    def under(self, data: Data, noise: Noise) -> LinearisedFit:
        """The same, whitened by another noise."""
        whitened_fit = whiten_fit(data.times, self.fitted.fit, noise)
        columns = _whitened(data, whitened_fit, self.response, self.families)
        return replace(self, whitened_fit=whitened_fit, columns=columns, noise=noise)

    def without(self, data: Data, force: ForceCandidate) -> list[Array]:
        """For each segment (m, nj + ne) the residual that a force leaves, all that is free refitted with it."""
        fit, white = self.fitted.fit, self.whitened_fit
        place = next(k for k, family in enumerate(self.families) if family is force.family)
        count = force.family.size
        both = np.column_stack([self.columns[place], white.movable])
        found = np.linalg.lstsq(both, white.residual, rcond=CUT)[0]
        moved = found[count:] * fit.parameters.scale
        changes = discard_unstable(responses(self.response, [force.family]))
        left = []
        parts = zip(data.times, fit.residuals, changes, fit.jacobians, fit.start_jacobians, white.starts, strict=True)
        for time, residual, change, by_theta, by_start, start in parts:
            rows = residual - change @ found[:count] - by_theta @ moved
            along = start.basis.T @ whiten(self.noise, time, rows).ravel()
            left.append(rows - by_start @ start.solution(along, CUT))
        return left


def linearise_fit(data: Data, fitted: Fitted, noise: Noise, dt: float = STEP) -> LinearisedFit | None:
    """The linear model about a fit; None where its motion cannot be followed.

    Args:
        data: what was measured.
        fitted: the hypothesis.
        noise: by which residual, derivatives and answers to forces are whitened.
        dt: physics step of motions that equations are linearised along [s].

    Raises:
        BudgetSpent: where the budget ends.
    """
    data.budget.check()
    model = fitted.fit.model
    whitened_fit = whiten_fit(data.times, fitted.fit, noise)

    def scale() -> Array:
        excitation = excitation_of(model, data.segments)
        return np.array([excitation[name].force for name in model.robot.joint_names])

    try:
        response = segment_response(
            data.simulator.engine, model, data.segments, fitted.fit.starts, scale, dt, data.simulator.threads
        )
    except SimulationDiverged:
        return None
    data.budget.check()
    linearised = observed(response, model.robot, data.segments)
    motions = list(linearised.motions)
    forces = [*families(model, motions), *harmonics(model, motions, frequencies(motions))]

    columns = _whitened(data, whitened_fit, linearised, forces)
    edges = np.cumsum([0, *[s.outputs.size for s in data.segments]])
    slices = [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]
    folds = [slices[k::FOLDS] for k in range(min(FOLDS, len(slices)))]
    if len(slices) == 1:
        folds = []
    price = data.thresholds.residual_price_alone
    return LinearisedFit(fitted, whitened_fit, forces, columns, folds, noise, motions, price, linearised)


def _whitened(
    data: Data, whitened_fit: WhitenedFit, response: ForceResponse, forces: Sequence[ForceFamily]
) -> list[Array]:
    """For each residual force (N, k) whitened changes of the measurements."""

    def whitened(batch: list[ForceFamily]) -> list[Array]:
        with np.errstate(over="ignore", invalid="ignore"):
            changes = discard_unstable(responses(response, batch))
            together = whitened_fit.columns(data.times, changes)
        ends = np.cumsum([family.size for family in batch])[:-1]
        return [np.ascontiguousarray(own) for own in np.split(together, ends, axis=1)]

    shared = computer.side_by_side(whitened_fit.threads, whitened, batches(forces))
    return [own for _, batch in shared for own in batch]


def frequencies(motions: Sequence[Motion]) -> list[float]:
    """Frequencies of disturbances in time that are looked for [Hz], 1/(2·T) apart, T the longest recording.

    That holds one period of the slowest; the fastest has ``PERIOD_SAMPLES`` samples in a period.
    """
    longest = min(max(m.time[-1] - m.start for m in motions), LONGEST)
    top = min(FASTEST, 1 / PERIOD_SAMPLES / float(np.median(np.diff(motions[0].time))))
    return [float(f) for f in np.arange(max(SLOWEST, 1.0 / longest), top, 0.5 / longest)]


def discard_unstable(answers: Sequence[Array]) -> list[Array]:
    """For each trial (m, nj, k) responses to k forces of 1 N·m or N, 0 for those that grew without bound [rad or m].

    They do so along an unstable motion. A force is dropped for all trials where it is for one.
    """
    bounded = np.all([(np.abs(a) < BOUND).all(axis=(0, 1)) for a in answers], axis=0)
    return list(answers) if bounded.all() else [np.where(bounded, a, 0.0) for a in answers]


def force_candidates(at: LinearisedFit, extra: Array | None = None) -> list[ForceCandidate]:
    """What every candidate force explains beside the free parameters, the best one first, see ``judged``.

    A parameter at an active bound stays there, or goes back inside where a force has it do so.

    Args:
        at: the linear model.
        extra: (N, k) whitened columns that are free as well.
    """
    white = at.whitened_fit
    residual, more = white.residual, [] if extra is None else [extra]
    within = Nuisance.of(np.column_stack([white.movable, *more]))
    anywhere = within if white.movable is white.slopes else Nuisance.of(np.column_stack([white.slopes, *more]))
    crossed = within.squares_beyond(residual) - anywhere.squares_beyond(residual)

    def found(family: ForceFamily, columns: Array) -> ForceCandidate:
        own = explained(residual, within, columns, folds=at.folds)
        if anywhere is not within:
            free = explained(residual, anywhere, columns, folds=at.folds)
            rest = anywhere.basis.T @ (residual - columns @ free.coefficients)
            if white.inside(anywhere.solution(rest, CUT)[: white.slopes.shape[1]]):
                own = replace(free, total=own.total, gain=free.gain + crossed, held_out=free.held_out + crossed)
        return ForceCandidate(family, own)

    candidates = computer.in_threads(white.threads, found, at.families, at.columns)
    return sorted(candidates, key=lambda force: -judged(force.found, at))


def judged(explanation: Explained, at: LinearisedFit) -> float:
    """Fall of χ² in cross-validation; without folds that on what was fitted, less a price of each parameter."""
    return explanation.held_out if at.folds else explanation.gain - at.price * explanation.rank
