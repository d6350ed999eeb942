"""Residuals of the best hypothesis: residual forces that explain them, and effects that are confounded with these."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from equimus_ctrl.diagnosis.candidates import excitation_of
from equimus_ctrl.diagnosis.confounding import confounded, restates
from equimus_ctrl.diagnosis.explained_variance import Explained
from equimus_ctrl.diagnosis.fitting import Data, Fitted, whitened
from equimus_ctrl.diagnosis.force_basis import Axis, Group
from equimus_ctrl.diagnosis.localization import excess_variances
from equimus_ctrl.diagnosis.policy import Thresholds
from equimus_ctrl.diagnosis.residual_force import ForceCandidate, LinearisedFit, force_candidates, judged, linearise_fit
from equimus_ctrl.diagnosis.results import Unexplained
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.noise import Noise
from equimus_ctrl.identification.parameters import place_unit
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.residuals import followed
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.types import Array

TRIED = 5
"""So many residual forces, the best in cross-validation, may replace an effect."""
MOST = 3
"""How many residual forces are reported at most."""
UNTOLD = 1e-4
"""A component of a force is not reported where the parameters' Jacobian leaves less than this share orthogonal."""
REFIT = 12
"""Steps of a fit to everything, what was held out too."""
POINTS = 61
CONFIDENT = 1.96


@dataclass(frozen=True, eq=False)
class ResidualAnalysis:
    """Analysis of the residuals of a hypothesis.

    Attributes:
        unexplained: forces that nothing named explains, strongest first.
        redundant: places of parts of the hypothesis that such a force explains as well or better.
    """

    unexplained: tuple[Unexplained, ...]
    redundant: tuple[int, ...]


def residual_analysis(data: Data, base: Fitted, best: Fitted, without: Sequence[Fitted]) -> ResidualAnalysis:
    """Find residual forces in the residuals of a fitted hypothesis.

    Args:
        data: what was measured.
        base: the model without any hypothesis.
        best: the hypothesis.
        without: for each of its parts the fit that does without it.
    """
    at = linearise_fit(data, best, best.noise)
    if at is None:
        return ResidualAnalysis((), ())
    all_redundant = ResidualAnalysis((), tuple(range(len(best.hypothesis))))
    # Where errors add up, the residuals without the effects are too large for forces to first order along the motion.
    held_in_place = data.free.model.robot.traits.held_in_place
    if held_in_place and _reproduced(data, base, best):
        # Enough effects reproduce anything; a single force that does so is the simpler explanation.
        return all_redundant
    taken = _squares(data, base, best) - _squares(data, best, best)
    thresholds, n = data.thresholds, data.n

    def least(t: Thresholds) -> float:
        return max(t.residual_gain, t.residual_share * n)

    found: list[tuple[ForceCandidate, Array]] = []
    extra: Array | None = None
    for _ in range(MOST):
        ranked = force_candidates(at, extra)
        top = ranked[0]
        whole = max(taken, 0.0) + sum(f.found.gain for f, _ in found) + top.found.gain
        if thresholds.decides(partial(_but_a_trace, judged(top.found, at), top.found.gain, whole, least)):
            break
        columns = at.columns[next(k for k, g in enumerate(at.groups) if g is top.group)]
        found.append((top, columns))
        extra = columns if extra is None else np.column_stack([extra, columns])
    confounded_places: tuple[int, ...] = ()
    if held_in_place:
        own = _squares(data, best, best)
        confounded_places = confounded(
            at, [_squares(data, fitted, best) - own for fitted in without], taken, least, thresholds
        )
    if not found:
        return ResidualAnalysis(_much(data, best), confounded_places)
    if not held_in_place and _reproduced(data, base, best):
        # So residual forces do not decide on effects that leave no residuals.
        return all_redundant
    replaced = _redundant(data, best, without, found[0][0].found.gain)
    redundant = tuple(sorted({*confounded_places, *replaced, *_barely(data, best)}))
    total = sum(f.found.gain for f, _ in found)
    residual_forces = tuple(
        _residual_force(data, at, f, columns, f.found.gain / total, least(thresholds)) for f, columns in found
    )
    return ResidualAnalysis(residual_forces, redundant)


def _but_a_trace(fall: float, gain: float, whole: float, least: Callable[[Thresholds], float], t: Thresholds) -> bool:
    """Whether a residual force explains too little to be reported."""
    return fall < least(t) or gain < t.trace * whole


def _much(data: Data, best: Fitted) -> tuple[Unexplained, ...]:
    """Joints whose residuals are far above the noise, though no residual force that was tried explains them.

    Where a robot is held in place, some force explains all missing physics to first order.
    """
    if data.free.model.robot.traits.held_in_place:
        return ()
    return _far_off(data, best.fit.residuals, best.noise)


def not_confirmed(
    data: Data, best: Fitted, validation: Sequence[Segment], residuals: Sequence[Array]
) -> ResidualAnalysis:
    """Joints whose residuals on held-out trials are far above the noise, whatever parameters the best hypothesis has.

    Enough effects at their bounds can reproduce the fitted trials; the held-out ones then reject them.

    Args:
        data: what was fitted.
        best: the hypothesis.
        validation: what was not.
        residuals: for each of these (m, nj) what the hypothesis leaves there [rad].
    """
    if not validation or not _far_off(data, residuals, best.noise):
        return ResidualAnalysis((), ())
    whole = replace(data, segments=[*data.segments, *validation])
    starts, _ = followed(best.fit.model, validation, data.simulator)
    begin = (best.fit.theta, [*best.fit.starts, *starts])
    try:
        refitted = whole.coarse_fit(best.hypothesis, [begin], best.noise, REFIT, 1e-5)
    except SimulationDiverged:
        left = residuals
    else:
        left = refitted.fit.residuals[len(data.segments) :]
    return ResidualAnalysis(tuple(replace(o, only_on="validation") for o in _far_off(data, left, best.noise)), ())


def not_on_test(data: Data, best: Fitted, test: Sequence[Segment], residuals: Sequence[Array]) -> ResidualAnalysis:
    """Joints whose residuals on test trials are far above the noise; nothing is fitted there but the starts.

    Args:
        data: what was fitted.
        best: the hypothesis.
        test: what took no part.
        residuals: for each of these (m, nj) what the hypothesis leaves there [rad].
    """
    if not test or not _far_off(data, residuals, best.noise):
        return ResidualAnalysis((), ())
    _, left = followed(best.fit.model, test, data.simulator)
    return ResidualAnalysis(tuple(replace(o, only_on="test") for o in _far_off(data, left, best.noise)), ())


def _far_off(data: Data, residuals: Sequence[Array], noise: Noise) -> tuple[Unexplained, ...]:
    excess, thresholds = excess_variances(residuals, noise), data.thresholds
    nothing = np.empty(0)
    return tuple(
        Unexplained(
            joint, float(own / excess.sum()), "", (joint,), own, thresholds.far_off, "", "", "",
            nothing, nothing, nothing,
        )
        for joint, own in zip(data.free.model.robot.joint_names, map(float, excess), strict=True)
        if thresholds.decides(partial(_above, own))
    )  # fmt: skip


def _above(excess: float, t: Thresholds) -> bool:
    return excess > t.far_off


def _reproduced(data: Data, base: Fitted, best: Fitted) -> bool:
    """Whether one residual force explains as much as several effects together, or as one at its bounds."""
    if len(best.hypothesis) < 2 and not (best.hypothesis and strained(data, best)):
        return False
    return _stands_in(
        data, base, best, _squares(data, base, best) - _squares(data, best, best), lambda t: t.replaces_all, 1
    )


def _stands_in(
    data: Data, without: Fitted, best: Fitted, gap: float, share: Callable[[Thresholds], float], tried: int
) -> bool:
    """Whether one of the best residual forces, added to a hypothesis, explains this share of a fall of χ²."""
    at = linearise_fit(data, without, best.noise)
    if at is None:
        return False
    at_joints = not data.free.model.robot.traits.forces_along_actuators
    forces = [(force.found.gain, restates(force.group, best.hypothesis, at_joints)) for force in force_candidates(at)]
    others = [(gain, restated) for gain, restated in forces if restated != "same"][:tried]
    return data.thresholds.decides(
        lambda t: any(gain > (t.replaces_restated if restated else share(t)) * gap for gain, restated in others)
    )


def _squares(data: Data, fitted: Fitted, noisy: Fitted) -> float:
    """χ² of a fit under the noise of another."""
    return sum(float((w**2).sum()) for w in whitened(data, noisy.noise, fitted.fit.residuals))


def strained(data: Data, fitted: Fitted) -> bool:
    """Whether a parameter of some effect ended at a bound where the effect does not vanish."""
    first = len(data.free.free)
    for part in fitted.hypothesis:
        for i, key in enumerate(part.values):
            side = int(fitted.fit.at_bound[first + i])
            harmless = side < 0 and part.candidate.effect.parameter_info()[key]["low"] == 0.0
            if side and not harmless:
                return True
        first += part.candidate.n_parameters
    return False


def _redundant(data: Data, best: Fitted, without: Sequence[Fitted], left: float) -> tuple[int, ...]:
    """Parts in whose place one residual force explains as much as the part and the remaining force together."""
    own = _squares(data, best, best)
    return tuple(
        k
        for k, fitted in enumerate(without)
        if _stands_in(data, fitted, best, _squares(data, fitted, best) - own + left, lambda t: t.replaces_one, TRIED)
    )


def _barely(data: Data, best: Fitted) -> tuple[int, ...]:
    """Parts at parameters that strain their laws, see ``Effect.degenerate``."""
    excitation = excitation_of(data.free.model, data.segments)
    return tuple(
        k
        for k, part in enumerate(best.hypothesis)
        if any(part.candidate.effect.degenerate(part.values, excitation[place]) for place in part.candidate.locations)
    )


def _residual_force(
    data: Data, at: LinearisedFit, top: ForceCandidate, columns: Array, share: float, threshold: float
) -> Unexplained:
    group = top.group
    joint = _joint(at, group, top.found)
    axis = group.axes[0] if len(group.axes) == 1 else None
    x = force = band = np.empty(0)
    if axis is not None:
        x = np.linspace(*axis.range, POINTS)
        force, band = _curve(at, columns, axis, x)
    names = {"joint": data.free.model.robot.joint_names, "actuator": data.free.model.robot.actuator_names}
    places = tuple(names[kind][i] for kind, i in group.forces)
    unit = place_unit(data.free.model, f"{_unit('N·m', group)} | {_unit('N', group)}", places[0])
    return Unexplained(
        joint,
        share,
        group.depends_on,
        places,
        judged(top.found, at),
        threshold,
        unit,
        axis.name if axis else "",
        axis.unit if axis else "",
        x,
        force,
        band,
    )


def _unit(force: str, group: Group) -> str:
    kind = group.factor.partition(".")[0]
    return {"": force, "vel": f"{force}·s/rad", "rate": f"{force}·s/m", "cmd": f"{force}/Pa", "len": f"{force}/m"}.get(
        kind, force
    )


def _joint(at: LinearisedFit, group: Group, found: Explained) -> str:
    """The joint on which the force does the most work, of those it acts on."""
    joints = at.fitted.fit.model.robot.joint_names
    work = np.zeros(len(joints))
    for torque, motion in zip(group.torques(at.motions), at.motions, strict=True):
        fitted = torque @ found.coefficients
        stiff = np.maximum(np.ptp(motion.position, axis=0), 1e-6)
        work += (fitted - fitted.mean(axis=0)).std(axis=0) * stiff
    allowed = [joints.index(name) for name in group.joints]
    return joints[max(allowed, key=lambda j: work[j])]


def _curve(at: LinearisedFit, columns: Array, axis: Axis, x: Array) -> tuple[Array, Array]:
    """(n,) the force over its coordinate and half the width of its 95 % interval, both without their means.

    Both are without the component along the parameters' Jacobian, which the data do not identify.
    """
    beside = Nuisance.of(at.whitened_fit.slopes)
    free = beside.project_out(columns)
    strength, turn = np.linalg.eigh(free.T @ free)
    whole = float(np.linalg.eigvalsh(columns.T @ columns)[-1])
    determined = strength > UNTOLD * max(whole, 1e-300)
    residual = beside.project_out(at.whitened_fit.residual)
    found = (turn[:, determined].T @ (free.T @ residual)) / strength[determined]
    rows = axis.basis(x)
    rows = (rows - rows.mean(axis=0)) @ turn[:, determined]
    return rows @ found, np.asarray(CONFIDENT * np.linalg.norm(rows / np.sqrt(strength[determined]), axis=1))
