"""Whether the torque domain shows a law that simulation has found: two estimates of one size that have to agree.

Simulated errors add up along a trial, so a law that is not there can gain by following the slow errors of what else the
model lacks: a ripple of a newton along a screw, say, of which inverse dynamics along the same motion show less than a
third. Under the right law both estimates tend to one size; where they differ the model is misspecified (Hausman,
"Specification tests in econometrics", 1978). With r the forces that the model lacks without the law, C c what the law
adds to them at the sizes c that simulation found, and the parameters to estimate projected out of both,

    share = max over c' (‖r‖² − ‖r − C c'‖²) / ‖C c‖²

is 1 where both agree, and 0 where the forces show nothing of it.

The other way round, a residual force that the torque domain does not show is no reason to call a law another one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, parameters_of
from equimus_ctrl.diagnosis.torque_screening import CORRELATED, WEAK, TorqueDomain, screened_at, torque_screen
from equimus_ctrl.effects.force import ForceEffect


def share_in_torques(data: Data, domain: TorqueDomain, fitted: Fitted, k: int) -> float:
    """Of what a part would explain in the torque domain at its simulated sizes the share that some of it does explain.

    Inf where the torque domain does not say: of what is no smooth force at joints, of dry friction, which acts where
    joints stand, too, and of a law that would explain too little to be seen, see ``Thresholds.uninformative``.

    Args:
        data: what was measured.
        domain: the same in the torque domain.
        fitted: the hypothesis.
        k: place of the part.
    """
    part = fitted.hypothesis[k]
    effect, own = part.candidate.effect, part.values
    if (
        not issubclass(effect, ForceEffect)
        or effect.rubs
        or effect.loads
        or part.candidate.own
        or part.candidate.absent
    ):
        return math.inf
    rest = (*fitted.hypothesis[:k], *fitted.hypothesis[k + 1 :])
    pool = [replace(part.candidate, guesses=(own,))]
    free = parameters_of(data.free, rest)
    screen = screened_at(free, data.theta_of(fitted.fit.theta, rest), data, domain, pool)
    if not screen.columns:
        return math.inf
    (law,) = screen.columns
    sizes = np.array([own[name] - law.nothing(name) for name in law.scaled])
    gram = screen.beyond[np.ix_(law.place, law.place)]
    expected, aim = float(sizes @ gram @ sizes), screen.beyond[law.place, -1]
    if data.thresholds.decides(lambda t: expected / CORRELATED < t.uninformative):
        return math.inf
    return float(aim @ np.linalg.pinv(gram, rcond=WEAK, hermitian=True) @ aim) / expected


def shown_in_torques(data: Data, domain: TorqueDomain, fitted: Fitted, k: int) -> bool:
    """Whether the torque domain shows enough of a part, see ``Thresholds.torque_share``, or says nothing of it."""
    share = share_in_torques(data, domain, fitted, k)
    return data.thresholds.decides(lambda t: share >= t.torque_share)


def more_beside(
    data: Data, domain: TorqueDomain, hypothesis: Hypothesis, further: Sequence[Candidate]
) -> dict[int, float]:
    """For places of force laws what one of some candidates explains more in the torque domain, over what the law does.

    Each beside all other laws, of which sizes are fitted there.

    Args:
        data: what was measured.
        domain: the same in the torque domain.
        hypothesis: with the laws.
        further: of which the one counts that explains most at a law's places.
    """
    laws = {k: part for k, part in enumerate(hypothesis) if issubclass(part.candidate.effect, ForceEffect)}
    pool = {k: replace(part.candidate, guesses=(part.values,)) for k, part in laws.items()}
    screen = torque_screen(data, domain, None, [*pool.values(), *further])
    columns = {k: own for k, candidate in pool.items() for own in screen.columns if own.candidate is candidate}
    whole = list(columns.values())
    left, _ = screen.fitted(whole)
    found = dict[int, float]()
    for k in columns:
        places = set(laws[k].candidate.locations)
        own = [c for c in screen.columns if c.candidate in further and places.intersection(c.candidate.locations)]
        more = max((left - screen.fitted([*whole, c])[0] for c in own), default=0.0)
        fall = screen.fitted([c for j, c in columns.items() if j != k])[0] - left
        found[k] = more / max(fall, 1e-300)
    return found
