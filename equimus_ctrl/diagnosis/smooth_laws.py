"""Whether the laws of a hypothesis are the right ones: a force of any smooth shape, simulated beside them.

A law that is nearly right may leave residuals that pass for coloured noise, and then no residual force is found to
first order: dry friction that depends on the angle in the place of viscous friction that does, say. So at each joint
of a hypothesis a smooth force over the angle, one over the speed, and one that is the speed times a function of the
angle, is fitted beside it (``effects.smooth``), begun at nothing. The hypothesis is nested in what is fitted, so its
gain is judged by the likelihood-ratio test, and on validation trials, as that of any part.

Where there is a torque domain, only what it asks for is simulated.

Several laws of one joint may together be what none of them is, one against the other. So such a force is also fitted in
the place of all that act at a joint alone, where it has no more parameters than they.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from equimus_ctrl.diagnosis.alternatives import without_parts
from equimus_ctrl.diagnosis.budget import BudgetSpent
from equimus_ctrl.diagnosis.confirmation import carried_over, confirms
from equimus_ctrl.diagnosis.coordinates import Coordinate
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.forces_beside import (
    CONFIDENT,
    WIDER,
    alone_at,
    along,
    another_law,
    asked_in_torques,
    fitted_without,
    force_of,
    joints_of,
    share_beyond,
)
from equimus_ctrl.diagnosis.friction_over_angle import friction_in_place
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.holdout_residuals import HoldoutResiduals
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part
from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.diagnosis.residuals import ResidualForce, Unexplained
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.diagnosis.torque_agreement import more_beside
from equimus_ctrl.diagnosis.unexplained import GENERALISED, OUTDONE, ResidualAnalysis, residual_analysis
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.effects.smooth import SmoothForce
from equimus_ctrl.engines.mjcf_inverse import law_slopes
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.parameters import place_unit
from equimus_ctrl.types import Array

POINTS = 61
"""At which the curve of a force is given."""


@dataclass(frozen=True)
class Shape:
    """What a smooth force depends on.

    Attributes:
        over: ``pos`` or ``vel``.
        times_rate: whether it is multiplied by the rate.
    """

    over: Literal["pos", "vel"]
    times_rate: bool


SHAPES = (Shape("pos", False), Shape("vel", False), Shape("pos", True))


@dataclass(frozen=True, eq=False)
class SmoothLaw:
    """A smooth force beside a hypothesis.

    Attributes:
        joint: where.
        shape: on what it depends.
        fitted: the hypothesis with it.
        gain: −2Δln L by it.
    """

    joint: str
    shape: Shape
    fitted: Fitted
    gain: float


def analysed(search: Search, state: SearchState, split: Split, before: Sequence[Unexplained] = ()) -> ResidualAnalysis:
    """The analysis of the residuals that a search's end leaves, with smooth forces beside its laws.

    Where robots are held in place, residual forces say as much to first order. Where the budget ends, what they say.
    A law that a smooth force makes redundant is rejected at the force's joint.

    Args:
        search: that ended.
        state: the end.
        split: with the validation trials.
        before: what was left beside laws of which some were rejected: its joints are asked again, with or without
            other laws, where no force is found at them to first order.
    """
    own = _shown_in_torques(search, state.best, residual_analysis(search.data, state.base, state.best, state.without))
    if own.redundant:
        return own
    try:
        together = in_place_of_all(search, state, split)
        rather = {} if together else friction_in_place(search, state, split)
    except BudgetSpent:
        return own
    if together or rather:
        instead = {joint: _residual_force(search, law) for joint, (law, _) in together.items()}
        instead |= {friction.joint: friction.told(search) for friction in rather.values()}
        gone = dict.fromkeys(rather, GENERALISED)
        gone |= {k: OUTDONE for _, places in together.values() for k in places}
        return ResidualAnalysis(_with_instead(own.unexplained, instead), gone, instead=instead)
    also = _places(before) - _places(own.unexplained)
    if not (state.best.hypothesis or also) or search.data.free.model.robot.traits.held_in_place:
        return own
    try:
        laws = beside(search, state, split, also)
        replaced = redundant(search, state, laws)
    except BudgetSpent:
        return own
    told = {law.joint: law for law in (*laws, *replaced.values())}
    forces = [_residual_force(search, law) for law in told.values()]
    places: dict[int, set[str]] = {}
    for k, joint in sorted(replaced):
        places.setdefault(k, set()).add(joint)
    stay = {k: _others(state.best.hypothesis[k], joints) for k, joints in places.items()}
    return ResidualAnalysis(
        _together(own.unexplained, forces),
        dict.fromkeys(places, GENERALISED),
        {k: locations for k, locations in stay.items() if locations},
    )


def _shown_in_torques(search: Search, best: Fitted, analysis: ResidualAnalysis) -> ResidualAnalysis:
    """The same without laws that a force would generalise of which the torque domain shows too little.

    There the speed times a function of the angle has to explain ``Thresholds.generalised_share`` of what the law does,
    as residual forces have to. Residuals are weighed by coloured noise, which slow forces resemble; the torque domain
    weighs them as they are.
    """
    asked = {k for k, reason in analysis.redundant.items() if reason == GENERALISED}
    if not asked or (domain := search.torque_domain) is None:
        return analysis
    data, excitation = search.data, excitation_of(search.data.free.model, search.data.segments)
    joints = _joints(search, best, ())
    further = [_candidate(joint, shape, excitation[joint]) for joint in joints for shape in SHAPES if shape.times_rate]
    shown = dict[int, float]()
    for times in WIDER:
        wider = replace(domain, width=times * domain.width)
        for k, share in more_beside(data, wider, best.hypothesis, further).items():
            shown[k] = max(share, shown.get(k, 0.0))
    little = {k for k in asked & shown.keys() if data.thresholds.decides(partial(_too_little, shown[k]))}
    return replace(analysis, redundant={k: why for k, why in analysis.redundant.items() if k not in little})


def _too_little(share: float, t: Thresholds) -> bool:
    return share < t.generalised_share


def analysed_without(search: Search, state: SearchState, split: Split, beside: ResidualAnalysis) -> ResidualAnalysis:
    """The analysis of what is left once parts that were redundant are rejected.

    What was left beside them stays where nothing else is: something is missing there, whatever it is. A force that was
    simulated in a part's place is told in the place of those to first order at its joint.

    Args:
        search: that ended.
        state: the end without these parts.
        split: with the validation trials.
        beside: the analysis with them.
    """
    analysis = analysed(search, state, split, beside.unexplained)
    if not (state.best.hypothesis or analysis.unexplained):
        analysis = ResidualAnalysis(beside.unexplained)
    left = {own.location for own in analysis.unexplained}
    instead = {**{joint: force for joint, force in beside.instead.items() if joint in left}, **analysis.instead}
    return replace(analysis, unexplained=_with_instead(analysis.unexplained, instead), instead=instead)


def without_redundant(
    search: Search, state: SearchState, analysis: ResidualAnalysis
) -> tuple[SearchState, dict[Part, str]]:
    """An end without what its analysis makes redundant, which never comes back, and that with the reasons.

    Args:
        search: that ended.
        state: the end.
        analysis: of what it leaves.

    Raises:
        BudgetSpent: where the budget ends.
        SimulationDiverged: where what is left diverges.
    """
    rejected = analysis.rejected(state.best.hypothesis)
    state = without_parts(search, state, tuple(analysis.redundant), analysis.fewer)
    return state.rejecting(part.candidate for part in rejected), rejected


def _places(unexplained: Sequence[Unexplained]) -> set[str]:
    """Of residual forces."""
    return {force.location for force in unexplained if isinstance(force, ResidualForce)}


def _others(part: Part, joints: Collection[str]) -> tuple[str, ...]:
    """The places of a part but some."""
    return tuple(place for place in part.candidate.locations if place not in joints)


def _with_instead(known: Sequence[Unexplained], instead: Mapping[str, ResidualForce]) -> tuple[Unexplained, ...]:
    """What is left, at some joints the forces that were simulated in the place of laws there."""
    if not instead:
        return tuple(known)
    return _together([own for own in known if own.location not in instead], list(instead.values()))


def _together(known: Sequence[Unexplained], smooth: Sequence[ResidualForce]) -> tuple[Unexplained, ...]:
    """Residual forces to first order, and smooth ones at other joints, the strongest first; then other joints' rest."""
    forces = [force for force in known if isinstance(force, ResidualForce)]
    forces += [force for force in smooth if force.location not in _places(known)]
    total = sum(force.gain for force in forces)
    shared = [replace(force, share=force.gain / total) for force in sorted(forces, key=lambda f: -f.gain)]
    places = _places(forces)
    return (*shared, *(own for own in known if not isinstance(own, ResidualForce) and own.location not in places))


def beside(search: Search, state: SearchState, split: Split, also: Collection[str] = ()) -> tuple[SmoothLaw, ...]:
    """The smooth forces that the best hypothesis leaves unexplained, of each joint the one that gains most.

    A force counts where its gain exceeds the acceptance threshold and more than ``Thresholds.smooth_trace`` of what
    the hypothesis and it explain, and where validation trials confirm it.

    Args:
        search: that ended.
        state: the end.
        split: with the validation trials.
        also: joints that are asked though the hypothesis may have no law there.

    Raises:
        BudgetSpent: where the budget ends.
    """
    best = state.best
    whole = state.base.deviance - best.deviance
    found: dict[str, SmoothLaw] = {}
    for joint, shape, candidate in _asked_for(search, best, also):
        law = _fitted(search, best, joint, shape, candidate)
        if law is None:
            continue
        if search.data.thresholds.decides(partial(_but_a_trace, law.gain, whole)):
            continue
        if joint not in found or law.gain > found[joint].gain:
            found[joint] = law
    holdout = HoldoutResiduals(search.data, split, state)
    return tuple(
        law
        for law in found.values()
        if not split.validation or confirms(search, carried_over(search, holdout, best, law.fitted))
    )


def _but_a_trace(gain: float, whole: float, t: Thresholds) -> bool:
    return gain < t.smooth_trace * (whole + gain)


def redundant(search: Search, state: SearchState, laws: Sequence[SmoothLaw]) -> dict[tuple[int, str], SmoothLaw]:
    """Friction laws, by place and joint, that a smooth force at this joint shows not to be the right ones; that force.

    A law that the force could not draw by itself is none where it explains nothing more beside the force. With f the
    law's force at the instants measured, and B what the smooth force can be, it could draw it where ‖f − B b‖²/‖f‖² is
    below ``Thresholds.drawn`` at the best b. A law that it could draw, viscous friction where the force is the speed
    times a function of the angle, is another one where that function is no constant: with s the smooth force fitted
    without the law, ‖s − c·f‖²/‖s‖² is above ``Thresholds.no_constant`` at the best c. Other parts stay: what is left
    is then another thing. So do the other joints of a law with a size of its own at each.

    Raises:
        BudgetSpent: where the budget ends.
    """
    found: dict[tuple[int, str], SmoothLaw] = {}
    for law in laws:
        for k, part in enumerate(state.best.hypothesis):
            places = part.candidate.locations
            if law.joint not in places or not (part.candidate.each or len(places) == 1) or not _rubs(part):
                continue
            share = _not_drawn(search, law, part)
            drawn = search.data.thresholds.decides(partial(_could_be_drawn, share))
            if drawn and not (law.shape.times_rate and part.candidate.effect.depends() == {"vel"}):
                continue
            alone = _without(search, law, k)
            if alone is None or search.accepts(alone, law.fitted):
                continue
            other = replace(law, fitted=alone)
            if not drawn or search.data.thresholds.decides(partial(another_law, _beyond(search, other, part))):
                found.setdefault((k, law.joint), other)
    return found


def in_place_of_all(search: Search, state: SearchState, split: Split) -> dict[str, tuple[SmoothLaw, list[int]]]:
    """Smooth forces, by joint, that outdo all laws there together, with the places of these.

    Of joints at which several parts act, and nowhere else. The force has no more parameters than they; it scores better
    by what another hypothesis is taken for (``Scoring.outdoes``), and validation trials confirm it in their place.

    Args:
        search: that ended.
        state: the end.
        split: with the validation trials.

    Raises:
        BudgetSpent: where the budget ends.
    """
    best, found = state.best, dict[str, tuple[SmoothLaw, list[int]]]()

    def as_rich(places: Sequence[int]) -> bool:
        return sum(best.hypothesis[k].candidate.n_parameters for k in places) >= len(SmoothForce.neutral)

    several = {joint: at for joint, at in alone_at(search, best).items() if len(at) > 1 and as_rich(at)}
    if not several:
        return found
    excitation = excitation_of(search.data.free.model, search.data.segments)
    holdout = HoldoutResiduals(search.data, split, state)
    for joint, places in several.items():
        rest = fitted_without(search, best, tuple(p for k, p in enumerate(best.hypothesis) if k not in places))
        if rest is None:
            continue
        for shape in SHAPES:
            law = _fitted(search, rest, joint, shape, _candidate(joint, shape, excitation[joint]))
            if law is None or not search.outdoes(law.fitted, best):
                continue
            if split.validation and not confirms(search, carried_over(search, holdout, best, law.fitted)):
                continue
            if joint not in found or law.fitted.deviance < found[joint][0].fitted.deviance:
                found[joint] = replace(law, gain=rest.deviance - law.fitted.deviance), places
    return found


def _could_be_drawn(share: float, t: Thresholds) -> bool:
    return share < t.drawn


def _rubs(part: Part) -> bool:
    """Whether a part is a law of the speed, and of the angle at most beside it."""
    law = part.candidate.effect.depends() or set()
    return issubclass(part.candidate.effect, ForceEffect) and "vel" in law and law <= {"pos", "vel"}


def _slopes(candidate: Candidate, x: Array, rate: Array) -> Array:
    """(n, k) what a smooth force exerts for each of its coefficients."""
    values = candidate.at(SmoothForce.neutral, candidate.locations[0])
    return law_slopes(SmoothForce, values, x, rate, np.zeros_like(x))[:, : candidate.n_parameters]


def _not_drawn(search: Search, law: SmoothLaw, part: Part) -> float:
    """The share of a part's force that a smooth force cannot be, whatever it explains."""
    x, rate = along(search, law.joint)
    return share_beyond(force_of(part, law.joint, x, rate), _slopes(law.fitted.hypothesis[-1].candidate, x, rate))


def _beyond(search: Search, law: SmoothLaw, part: Part) -> float:
    """The share of a smooth force, fitted without a part, that is not the part's law, whatever size that has."""
    x, rate = along(search, law.joint)
    whole = force_of(law.fitted.hypothesis[-1], law.joint, x, rate)
    return share_beyond(whole, force_of(part, law.joint, x, rate)[:, None])


def _without(search: Search, law: SmoothLaw, k: int) -> Fitted | None:
    """A hypothesis with a smooth force and without one of its other parts at its joint; None where it diverges."""
    parts = law.fitted.hypothesis
    stay = _others(parts[k], (law.joint,))
    rest = (parts[k].narrowed(stay),) if stay else ()
    return fitted_without(search, law.fitted, (*parts[:k], *rest, *parts[k + 1 :]))


def _joints(search: Search, best: Fitted, also: Collection[str]) -> list[str]:
    """At which a hypothesis has parts, and others, in the robot's order."""
    own = {joint for part in best.hypothesis for joint in joints_of(search, part)}.union(also)
    return [name for name in search.data.free.model.robot.joint_names if name in own]


def _asked_for(search: Search, best: Fitted, also: Collection[str]) -> Iterator[tuple[str, Shape, Candidate]]:
    """Smooth forces that the torque domain asks for at a hypothesis' joints; all there where there is none."""
    excitation = excitation_of(search.data.free.model, search.data.segments)
    every = {
        _candidate(joint, shape, excitation[joint]): (joint, shape)
        for joint in _joints(search, best, also)
        for shape in SHAPES
    }
    for candidate in asked_in_torques(search, best, list(every)):
        yield (*every[candidate], candidate)


def _candidate(joint: str, shape: Shape, excitation: Excitation) -> Candidate:
    """A smooth force at a joint, within what recordings show of it."""
    low, width = (-excitation.speed, 2 * excitation.speed) if shape.over == "vel" else (excitation.low, excitation.span)
    given = {
        "over_rate": float(shape.over == "vel"),
        "times_rate": float(shape.times_rate),
        "low": low,
        "width": max(width, 1e-9),
        "speed": max(excitation.speed, 1e-9),
        "force_scale": max(excitation.force, 1e-9),
    }
    return Candidate(SmoothForce, (joint,), (dict(SmoothForce.neutral),), given=given)


def _fitted(search: Search, best: Fitted, joint: str, shape: Shape, candidate: Candidate) -> SmoothLaw | None:
    """A smooth force fitted beside a hypothesis, begun at nothing; None where that diverges.

    Its gain is over the better minimum of the hypothesis: the one it has, or the one next to where the fit ended.
    """
    data, n = search.data, candidate.n_parameters
    hypothesis = (*best.hypothesis, Part(candidate, dict(SmoothForce.neutral)))
    begin = (np.append(best.fit.theta, np.zeros(n)), best.fit.starts)
    try:
        fitted = data.coarse_fit(hypothesis, [begin], best.noise, search.settings.long_steps)
        if not search.accepts(best, fitted):
            return None
        fitted = data.converge(fitted)
        back = (fitted.fit.theta[:-n], fitted.fit.starts)
        plain = data.converge(data.coarse_fit(best.hypothesis, [back], best.noise, search.settings.long_steps))
    except SimulationDiverged:
        return None
    least = min(best, plain, key=lambda f: f.deviance)
    return SmoothLaw(joint, shape, fitted, least.deviance - fitted.deviance) if search.accepts(least, fitted) else None


def _residual_force(search: Search, law: SmoothLaw) -> ResidualForce:
    """Of a report; without a curve where recordings do not determine it beside the other laws.

    The curve and its interval are without their means, which are as much the model's own damping or weight.
    """
    model, part, axis = search.data.free.model, law.fitted.hypothesis[-1], Coordinate(law.shape.over, law.joint)
    given = part.candidate.given
    x = np.linspace(given["low"], given["low"] + given["width"], POINTS)
    rows = _slopes(part.candidate, x, x if law.shape.over == "vel" else np.ones_like(x))  # at a rate of 1
    rows -= rows.mean(axis=0)
    coefficients, spread = _coefficients(law)
    force = rows @ coefficients
    band = CONFIDENT * np.sqrt(np.maximum(((rows @ spread) * rows).sum(axis=1), 0.0))
    known = bool(np.all(np.isfinite(band)))
    factor = (Coordinate("vel", law.joint),) if law.shape.times_rate else ()
    return ResidualForce(
        location=law.joint,
        share=1.0,
        coordinates=(axis, *factor),
        places=(law.joint,),
        gain=law.gain,
        threshold=search.threshold(part.candidate.n_parameters),
        unit=place_unit(model, "N·m·s/rad" if law.shape.times_rate else "N·m", law.joint),
        axis=axis if known else None,
        axis_unit=place_unit(model, "rad" if law.shape.over == "pos" else "rad/s", law.joint) if known else "",
        x=x if known else np.empty(0),
        force=force if known else np.empty(0),
        band=band if known else np.empty(0),
    )


def _coefficients(law: SmoothLaw) -> tuple[Array, Array]:
    """(k,) a smooth force's coefficients, and (k, k) their covariance; nan where one is not identifiable."""
    k, uncertainty = law.fitted.hypothesis[-1].candidate.n_parameters, law.fitted.fit.uncertainty
    error = uncertainty.standard_error[-k:]
    with np.errstate(invalid="ignore"):
        return law.fitted.fit.theta[-k:], uncertainty.correlation[-k:, -k:] * np.outer(error, error)
