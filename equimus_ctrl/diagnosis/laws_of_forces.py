"""Laws that a residual force asks for, before it is reported as physics without a name.

Where there is a torque domain, laws with equations of their own that explain less there than others do are not
simulated (``torque_start.worth_compiling``), for that takes long. A force of another kind, or noise, may have hidden
one. So where the residuals ask for a force over just what such a law depends on, the law is fitted after all.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from equimus_ctrl.diagnosis.confounding import COORDINATES
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate
from equimus_ctrl.diagnosis.hypothesis_moves import HypothesisMoves
from equimus_ctrl.diagnosis.residuals import ResidualForce, Unexplained
from equimus_ctrl.diagnosis.screening import screen
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.noise import white_noise


def with_laws_of_forces(search: HypothesisMoves, end: SearchState, unexplained: Sequence[Unexplained]) -> SearchState:
    """A search's end, or a better hypothesis with one more law that its residual forces ask for; itself if none does.

    A law is asked for once.

    Args:
        search: that ended.
        end: of it.
        unexplained: the residuals that its hypothesis leaves.
    """
    best = end.best
    asked = _asked_for(search, end, unexplained)
    fits = _fits(search, best, asked)
    if asked:
        end = replace(end, tried=end.tried.having(*fits))
    good = (f for f in fits if search.accepts(best, f) and search.score(f) < search.score(best))
    top = min((f for f in good if not search.aliased(f)), key=search.score, default=None)
    return end if top is None else search.exchanged(replace(end, best=top, without=(), alternatives=()))


def _asked_for(search: HypothesisMoves, end: SearchState, unexplained: Sequence[Unexplained]) -> list[Candidate]:
    """Candidates at a residual force's place that were never fitted and depend on what it does."""
    if search.torque_domain is None:
        return []
    fitted = {candidate.label for tried in end.tried.fitted for candidate in tried.candidates}
    forces = [force for force in unexplained if isinstance(force, ResidualForce)]
    return [
        candidate
        for candidate in search.allowed_candidates(end.tried)
        if candidate.effect.own_equations
        and candidate.label not in fitted
        and any(_restates(candidate, force) for force in forces)
    ]


def _restates(candidate: Candidate, force: ResidualForce) -> bool:
    depends = {COORDINATES[coordinate.kind] for coordinate in force.coordinates}
    return candidate.locations == (force.location,) and candidate.effect.depends() == depends


def _fits(search: HypothesisMoves, best: Fitted, asked: Sequence[Candidate]) -> list[Fitted]:
    """A hypothesis with each of some candidates as one more part."""
    data, noise, fits = search.data, white_noise(best.fit.residuals), list[Fitted]()
    for own in screen(data, best, asked):
        search.notify(f"{own.candidate.label}, which a residual force asks for", best.label)
        begins = [(theta, best.fit.starts) for theta in own.begins(data, best)]
        with suppress(SimulationDiverged):  # so it cannot be what happened
            fits.append(data.converge(data.coarse_fit(own.hypothesis, begins, noise, search.settings.long_steps)))
    return fits
