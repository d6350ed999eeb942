"""Residuals of the best hypothesis: residual forces that explain them, and effects that are confounded with these."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np

from equimus_ctrl.diagnosis.confounding import confounded, generalises, restates
from equimus_ctrl.diagnosis.explained_variance import Explained
from equimus_ctrl.diagnosis.fitting import Data, Fitted, chi_squared
from equimus_ctrl.diagnosis.force_basis import Axis, ForceFamily
from equimus_ctrl.diagnosis.hypothesis import Hypothesis, Part
from equimus_ctrl.diagnosis.localization import excess_variances
from equimus_ctrl.diagnosis.noise_size import noise_sizes
from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.diagnosis.residual_force import ForceCandidate, LinearisedFit, force_candidates, judged, linearise_fit
from equimus_ctrl.diagnosis.residuals import ResidualAboveNoise, ResidualForce, Unexplained
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.noise import Noise, log_likelihood
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
"""At which the curve of a force is given."""
CONFIDENT = 1.96
"""Standard errors of its 95 % interval, by the normal distribution."""
REPRODUCED = "one residual force explains as much as all effects together"
CONFOUNDED = "it explains nothing more beside a residual force"
REPLACED = "a residual force in its place explains as much"
DEGENERATE = "its parameters strain its law"
GENERALISED = "what it leaves at its place goes with more than its law does"
OUTDONE = "one force explains more than all laws of its joint together"
"""Why parts of a hypothesis are rejected."""


@dataclass(frozen=True, eq=False)
class SelectedForce:
    """A residual force that counts.

    Attributes:
        candidate: where, on what it depends, and what it explains beside those selected before it.
        columns: (N, k) its whitened changes of the measurements.
    """

    candidate: ForceCandidate
    columns: Array

    @property
    def gain(self) -> float:
        """Fall of χ² on the trials fitted."""
        return self.candidate.found.gain


@dataclass(frozen=True, eq=False)
class ResidualAnalysis:
    """Analysis of the residuals of a hypothesis.

    Attributes:
        unexplained: forces, or joints, that nothing named explains, strongest first.
        redundant: places of parts of the hypothesis that are to be rejected, with the reason.
        fewer: of those the laws with a size of their own at each place that are rejected at some alone, with the
            places at which they stay.
        instead: forces, by joint, that were simulated in the place of parts, and stand for all that is missing there.
    """

    unexplained: tuple[Unexplained, ...] = ()
    redundant: Mapping[int, str] = field(default_factory=dict)
    fewer: Mapping[int, tuple[str, ...]] = field(default_factory=dict)
    instead: Mapping[str, ResidualForce] = field(default_factory=dict)

    def rejected(self, hypothesis: Hypothesis) -> dict[Part, str]:
        """The parts of the hypothesis that are rejected, or what is rejected of them, with the reason."""
        parts = {k: hypothesis[k] for k in self.redundant}
        for k, stay in self.fewer.items():
            parts[k] = parts[k].narrowed(tuple(p for p in parts[k].candidate.locations if p not in stay))
        return {parts[k]: reason for k, reason in self.redundant.items()}


def residual_analysis(data: Data, base: Fitted, best: Fitted, without: Sequence[Fitted]) -> ResidualAnalysis:
    """Find residual forces in the residuals of a fitted hypothesis, and parts that these make redundant.

    Nothing is found where the motion of the hypothesis cannot be followed.

    Args:
        data: what was measured.
        base: the model without any hypothesis.
        best: the hypothesis.
        without: for each of its parts the fit that does without it.
    """
    at = linearise_fit(data, best, best.noise)
    if at is None:
        return ResidualAnalysis()
    # Enough effects reproduce anything; a single force that does so is the simpler explanation.
    reproduced = ResidualAnalysis(redundant=dict.fromkeys(range(len(best.hypothesis)), REPRODUCED))
    # Where errors add up, the residuals without the effects are too large for forces to first order along the motion.
    held_in_place = data.free.model.robot.traits.held_in_place
    if held_in_place and _reproduced(data, base, best):
        return reproduced
    together = _fall(data, base, best, at.noise)
    strongest = force_candidates(at)[0]
    forces = select_forces(data, at, together, strongest)
    if not forces and (quieter := taken_off(data, at, strongest)) is not None:
        whole = _fall(data, base, best, quieter.noise)
        if forces := select_forces(data, quieter, whole):
            at, together = quieter, whole
    # Residual forces do not decide on effects that leave no residuals.
    if not held_in_place and forces and _reproduced(data, base, best):
        return reproduced
    redundant = redundant_parts(data, at, without, together, forces)
    unexplained = _residual_forces(data, at, forces) or _far_above_noise(data, best, best.fit.residuals)
    return ResidualAnalysis(unexplained, redundant)


def select_forces(
    data: Data, at: LinearisedFit, together: float, strongest: ForceCandidate | None = None
) -> list[SelectedForce]:
    """The residual forces that count, by forward selection: each the best beside those before it.

    The f-th lets χ² fall in cross-validation by most of all beside the columns of those before, see
    ``residual_force.judged``. It counts where that is max(``residual_gain``, ``simulation_error``·n) at least, and its
    gain at least ``trace`` of all that the effects and the forces up to it explain; the first that does not ends it.

    Args:
        data: what was measured.
        at: the hypothesis to first order.
        together: by how much χ² falls with all effects of the hypothesis.
        strongest: the first of ``force_candidates``, where it is known.
    """
    selected: list[SelectedForce] = []
    for _ in range(MOST):
        extra = np.column_stack([force.columns for force in selected]) if selected else None
        top = strongest if strongest and not selected else force_candidates(at, extra)[0]
        whole = max(together, 0.0) + sum(force.gain for force in selected) + top.found.gain
        if data.thresholds.decides(partial(_but_a_trace, judged(top.found, at), top.found.gain, whole, data.n)):
            break
        columns = at.columns[next(k for k, family in enumerate(at.families) if family is top.family)]
        selected.append(SelectedForce(top, columns))
    return selected


def redundant_parts(
    data: Data, at: LinearisedFit, without: Sequence[Fitted], together: float, forces: Sequence[SelectedForce]
) -> dict[int, str]:
    """Places of parts that residual forces make redundant, with the reasons.

    A part is confounded with a force beside which it explains nothing more; or a force in its place explains as much
    as the part and the strongest remaining force together; or it strains its law where forces remain, or where another
    part is at a bound of its own, and so has no name; or one says that its law is another, see ``_generalised``. With F
    the fall of χ² by a part, fitted, and g the gain of the strongest remaining force, a force replaces the part whose
    own gain is more than ``replaces_one``·(F + g); one that depends on more than the part's law has to gain
    ``replaces_restated`` of that.

    Args:
        data: what was measured.
        at: the hypothesis to first order.
        without: for each of its parts the fit that does without it.
        together: by how much χ² falls with all effects of the hypothesis.
        forces: that remain.
    """
    best = at.fitted
    falls = [_fall(data, fitted, best, at.noise) for fitted in without]
    reasons: list[tuple[int, str]] = []
    if data.free.model.robot.traits.held_in_place:
        places = confounded(at, falls, together, partial(_least, data.n), data.thresholds)
        reasons += [(k, CONFOUNDED) for k in places]
    if forces:
        for k, (fitted, fall) in enumerate(zip(without, falls, strict=True)):
            whole = fall + forces[0].gain
            if _replaced_by_force(data, fitted, best, at.noise, whole, lambda t: t.replaces_one, TRIED):
                reasons.append((k, REPLACED))
        reasons += [(k, GENERALISED) for force in forces for k in _generalised(data, best, falls, force)]
    nameless = strained(data, best)
    reasons += [(k, DEGENERATE) for k in _degenerate(data, best) if forces or set(nameless) - {k}]
    return {
        place: "; ".join(reason for k, reason in reasons if k == place) for place in sorted({k for k, _ in reasons})
    }


def _generalised(data: Data, best: Fitted, falls: Sequence[float], force: SelectedForce) -> list[int]:
    """Places of parts whose law a remaining force at their place would have depend on more.

    Friction that grows with the speed, and a force left at its joint that is the speed times a function of the angle:
    then the friction depends on the angle, which is another law. It is told where that force gains more than
    ``Thresholds.generalised_share`` of the part's own gain.
    """
    if data.free.model.robot.traits.forces_along_actuators:
        return []
    return [
        k
        for k, (part, fall) in enumerate(zip(best.hypothesis, falls, strict=True))
        if generalises(force.candidate.family, part)
        and data.thresholds.decides(partial(_another_law, force.gain, fall))
    ]


def _another_law(gain: float, fall: float, t: Thresholds) -> bool:
    return gain > t.generalised_share * fall


def _least(n: int, t: Thresholds) -> float:
    """The least fall of χ² for which a residual force is reported, of so many measurements."""
    return max(t.residual_gain, t.simulation_error * n)


def _but_a_trace(fall: float, gain: float, whole: float, n: int, t: Thresholds) -> bool:
    """Whether a residual force explains too little to be reported."""
    return fall < _least(n, t) or gain < t.trace * whole


def not_confirmed(
    data: Data, best: Fitted, validation: Sequence[Segment], residuals: Sequence[Array]
) -> ResidualAnalysis:
    """Joints whose residuals on held-out trials are far above the noise, whatever parameters the best hypothesis has.

    Enough effects at their bounds can reproduce the fitted trials; the held-out ones then reject them.

    Args:
        data: what was fitted.
        best: the hypothesis.
        validation: what was not.
        residuals: for each of these (m, nj + ne) what it leaves there, of joints [rad or m] and channels [own unit].

    Raises:
        BudgetSpent: where the budget ends.
    """
    if not validation or not _far_above_noise(data, best, residuals):
        return ResidualAnalysis()
    whole = replace(data, segments=[*data.segments, *validation])
    starts, _ = followed(best.fit.model, validation, data.simulator)
    begin = (best.fit.theta, [*best.fit.starts, *starts])
    try:
        refitted = whole.coarse_fit(best.hypothesis, [begin], best.noise, REFIT, 1e-5)
    except SimulationDiverged:
        remaining = residuals
    else:
        remaining = refitted.fit.residuals[len(data.segments) :]
    return ResidualAnalysis(_far_above_noise(data, best, remaining, "validation"))


def not_on_test(data: Data, best: Fitted, test: Sequence[Segment], residuals: Sequence[Array]) -> ResidualAnalysis:
    """Joints whose residuals on test trials are far above the noise; nothing is fitted there but the starts.

    Args:
        data: what was fitted.
        best: the hypothesis.
        test: what took no part.
        residuals: for each of these (m, nj + ne) what it leaves there, of joints [rad or m] and channels [own unit].
    """
    if not test or not _far_above_noise(data, best, residuals):
        return ResidualAnalysis()
    _, remaining = followed(best.fit.model, test, data.simulator)
    return ResidualAnalysis(_far_above_noise(data, best, remaining, "test"))


def _far_above_noise(
    data: Data, best: Fitted, residuals: Sequence[Array], only_on: Literal["", "validation", "test"] = ""
) -> tuple[ResidualAboveNoise, ...]:
    """Joints at which residuals are far above the noise, though nothing that was tried explains them."""
    thresholds = data.thresholds
    whole = excess_variances(residuals, noise_sizes(data, best))
    joints = data.free.model.robot.joint_names
    excess = whole[: len(joints)].copy()
    for k, j in enumerate(data.segments[0].channels.joints(data.free.model.robot)):
        if j is not None:
            excess[j] = max(excess[j], whole[len(joints) + k])
    return tuple(
        ResidualAboveNoise(joint, float(own / excess.sum()), own, thresholds.far_off, only_on)
        for joint, own in zip(joints, map(float, excess), strict=True)
        if thresholds.decides(partial(_above, own))
    )


def _above(excess: float, t: Thresholds) -> bool:
    return excess > t.far_off


def _reproduced(data: Data, base: Fitted, best: Fitted) -> bool:
    """Whether one residual force explains as much as several effects together, or as one at its bounds."""
    if len(best.hypothesis) < 2 and not (best.hypothesis and strained(data, best)):
        return False
    fall = _fall(data, base, best, best.noise)
    return _replaced_by_force(data, base, best, best.noise, fall, lambda t: t.replaces_all, 1)


def _replaced_by_force(
    data: Data,
    without: Fitted,
    best: Fitted,
    noise: Noise,
    fall: float,
    share: Callable[[Thresholds], float],
    tried: int,
) -> bool:
    """Whether one of the best residual forces, added to a hypothesis, explains a share of a fall of χ².

    Args:
        data: what was measured.
        without: the hypothesis.
        best: that with the parts that the force would replace; forces that restate these are no simpler.
        noise: by which χ² counts.
        fall: of it from the one to the other.
        share: that decides.
        tried: so many of the best forces.
    """
    at = linearise_fit(data, without, noise)
    if at is None:
        return False
    at_joints = not data.free.model.robot.traits.forces_along_actuators
    forces = [(force.found.gain, restates(force.family, best.hypothesis, at_joints)) for force in force_candidates(at)]
    others = [(gain, restated) for gain, restated in forces if restated != "same"][:tried]
    return data.thresholds.decides(
        lambda t: any(gain > (t.replaces_restated if restated else share(t)) * fall for gain, restated in others)
    )


def _fall(data: Data, without: Fitted, best: Fitted, noise: Noise) -> float:
    """By how much χ² falls from one hypothesis to another, under a noise."""
    before, after = (chi_squared(noise, data.times, fitted.fit.residuals) for fitted in (without, best))
    return before - after


def taken_off(data: Data, at: LinearisedFit, strongest: ForceCandidate) -> LinearisedFit | None:
    """A hypothesis whitened by the noise that is left where the strongest residual force is taken off.

    What a model leaves out is taken for noise by an estimate of that, as far as it goes on for no longer, and weighs
    less then. None where −2 ln L falls by less than what a force has to explain.
    """
    left = at.without(data, strongest)
    noise = data.noise_of(left)
    before, after = (
        -2.0 * log_likelihood(own, data.times, residuals)
        for own, residuals in ((at.noise, at.fitted.fit.residuals), (noise, left))
    )
    if data.thresholds.decides(lambda t: before - after < _least(data.n, t)):
        return None
    return at.under(data, noise)


def strained(data: Data, fitted: Fitted) -> list[int]:
    """Places of parts of which a parameter ended at a bound where the effect does not vanish."""
    first, found = len(data.free.free), list[int]()
    for k, part in enumerate(fitted.hypothesis):
        sides = fitted.fit.at_bound[first : first + part.candidate.n_parameters]
        info = part.candidate.effect.parameter_info()
        own = zip(sides, part.candidate.parameters, strict=True)
        if any(side and not (side < 0 and info[p.key]["low"] == 0.0) for side, p in own):
            found.append(k)
        first += part.candidate.n_parameters
    return found


def _degenerate(data: Data, best: Fitted) -> list[int]:
    """Places of parts at parameters that strain their laws, see ``Effect.degenerate``."""
    excitation = excitation_of(data.free.model, data.segments)
    return [
        k
        for k, part in enumerate(best.hypothesis)
        if any(
            part.candidate.effect.degenerate(part.candidate.at(part.values, place), excitation[place])
            for place in part.candidate.locations
        )
    ]


def _residual_forces(data: Data, at: LinearisedFit, forces: Sequence[SelectedForce]) -> tuple[ResidualForce, ...]:
    """Of a report, each with its share of what all explain."""
    total = sum(force.gain for force in forces)
    threshold = _least(data.n, data.thresholds)
    return tuple(_residual_force(data, at, force, force.gain / total, threshold) for force in forces)


def _residual_force(
    data: Data, at: LinearisedFit, force: SelectedForce, share: float, threshold: float
) -> ResidualForce:
    family, explanation = force.candidate.family, force.candidate.found
    axis = family.axes[0] if len(family.axes) == 1 else None
    x = curve = band = np.empty(0)
    if axis is not None:
        x = np.linspace(*axis.range, POINTS)
        curve, band = _curve(at, force.columns, axis, x)
    names = {"joint": data.free.model.robot.joint_names, "actuator": data.free.model.robot.actuator_names}
    places = tuple(names[kind][i] for kind, i in family.forces)
    return ResidualForce(
        location=_joint(at, family, explanation),
        share=share,
        coordinates=family.coordinates,
        places=places,
        gain=judged(explanation, at),
        threshold=threshold,
        unit=place_unit(data.free.model, f"{_unit('N·m', family)} | {_unit('N', family)}", places[0]),
        axis=axis.coordinate if axis else None,
        axis_unit=axis.unit if axis else "",
        x=x,
        force=curve,
        band=band,
    )


def _unit(force: str, family: ForceFamily) -> str:
    """Of the function that a factor multiplies; a sign has no unit."""
    if family.factor is None or family.factor.sign:
        return force
    per = {"vel": "·s/rad", "rate": "·s/m", "cmd": "/Pa", "len": "/m"}
    return force + per.get(family.factor.kind, "")


def _joint(at: LinearisedFit, family: ForceFamily, explanation: Explained) -> str:
    """The joint on which the force does the most work, of those it acts on."""
    joints = at.fitted.fit.model.robot.joint_names
    work = np.zeros(len(joints))
    for torque, motion in zip(family.torques(at.motions), at.motions, strict=True):
        fitted = torque @ explanation.coefficients
        stiff = np.maximum(np.ptp(motion.position, axis=0), 1e-6)
        work += (fitted - fitted.mean(axis=0)).std(axis=0) * stiff
    allowed = [joints.index(name) for name in family.joints]
    return joints[max(allowed, key=lambda j: work[j])]


def _curve(at: LinearisedFit, columns: Array, axis: Axis, x: Array) -> tuple[Array, Array]:
    """(n,) the force over its coordinate and half the width of its 95 % interval, both without their means.

    Both are without the component along the parameters' Jacobian, which the data do not identify.
    """
    beside = Nuisance.of(at.whitened_fit.movable)
    free = beside.project_out(columns)
    strength, turn = np.linalg.eigh(free.T @ free)
    whole = float(np.linalg.eigvalsh(columns.T @ columns)[-1])
    determined = strength > UNTOLD * max(whole, 1e-300)
    residual = beside.project_out(at.whitened_fit.residual)
    coefficients = (turn[:, determined].T @ (free.T @ residual)) / strength[determined]
    rows = axis.basis(x)
    rows = (rows - rows.mean(axis=0)) @ turn[:, determined]
    return rows @ coefficients, np.asarray(CONFIDENT * np.linalg.norm(rows / np.sqrt(strength[determined]), axis=1))
