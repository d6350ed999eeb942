"""A diagnosis without the error of the engine's physics step: that is no physics, and counts in intervals."""

from __future__ import annotations

from dataclasses import replace

from equimus_ctrl.diagnosis.alternatives import without_parts
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis_moves import SearchHistory, SearchState
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.unexplained import ResidualAnalysis, residual_analysis
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.noise import Noise
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.identification.step_error import changes_between, with_step_error
from equimus_ctrl.identification.whitened_fit import whiten_fit


def without_step_error(
    search: Search, found: SearchState, rest: ResidualAnalysis, threads: int | None
) -> tuple[Search, SearchState, ResidualAnalysis, str] | None:
    """The search's end without the discretisation error, where less physics is missing then, and a sentence on it.

    A robot's own step belongs to the simulation that is being corrected, but residuals of its error are no physics.
    Nothing is done where the engine's discretisation error does not count.
    """
    engine, best = search.data.simulator.engine, found.best
    if (own_step := engine.discretisation) is None or not (best.hypothesis or rest.unexplained):
        return None
    step = own_step.step / own_step.finer
    data = replace(search.data, simulator=Simulator(engine.without_step_error(), threads), coarse=None)
    try:
        left_by_best, error = _step_error(search.data, data.simulator, best, best.noise)
        others = [_step_error(search.data, data.simulator, f, best.noise) for f in found.without]
    except SimulationDiverged:
        return None
    thresholds, n = data.thresholds, data.n

    def may_be_the_steps(left: float, own_error: float) -> bool:
        return thresholds.decides(lambda t: left - left_by_best < t.step_explains * own_error)

    uncertain_parts = [k for k, of in enumerate(others) if may_be_the_steps(*of)]
    if not uncertain_parts and thresholds.decides(lambda t: error < t.step_matters * n):
        return None
    own = replace(data, fine=data.simulator)
    exact_best = own.converge_finely(best)
    needless = [k for k in uncertain_parts if not search.accepts(own.converge_finely(found.without[k]), exact_best)]
    if not needless and not rest.unexplained:
        return None
    other = Search(data, search.pool, search.settings, fits_with_other_engine=found.tried.fitted)
    base = own.converge_finely(found.base)
    # Alternatives were fitted with the XML's step, so their likelihoods are not comparable with what follows.
    anew = SearchHistory(first=found.tried.first, rejected=found.tried.rejected)
    start = replace(found, base=base, alternatives=tuple(() for _ in best.hypothesis), tried=anew)
    exact = other.moved(start, exact_best if best.hypothesis else base)
    exact = without_parts(other, exact, needless[:1])
    saved = max(best.n_parameters - exact.best.n_parameters, 1)
    if exact.best.deviance - best.deviance > search.threshold(saved):
        return None  # the robot does more as with the XML's step, of which a controller's own may be the reason
    left = residual_analysis(data, base, exact.best, exact.without)
    if not needless and left.unexplained:
        return None
    return (
        other,
        exact,
        left,
        (
            f"The physics step of the XML, {1e3 * own_step.step:g} ms, is too long for these recordings: its error "
            "would be taken for missing physics. All of this but the ranking was worked out without that error, from "
            f"simulations with {1e3 * step:g} ms too."
        ),
    )


def step_counted(data: Data, found: SearchState, threads: int | None) -> SearchState:
    """The end with intervals that the error of the engine's physics step is counted in."""
    engine = data.simulator.engine
    if (step := engine.discretisation) is None:
        return found
    other, ratio = Simulator(engine.with_finer_step(), threads), 1 / step.finer

    def counted(fitted: Fitted) -> Fitted:
        fit = with_step_error(fitted.fit, data.segments, data.simulator, other, ratio, fitted.noise)
        return replace(fitted, fit=fit)

    best = counted(found.best)
    return replace(found, best=best, base=best if found.base is found.best else counted(found.base))


def _step_error(data: Data, finer: Simulator, fitted: Fitted, noise: Noise) -> tuple[float, float]:
    """χ² that a hypothesis leaves, and that of a finer step's change orthogonal to parameters and initial states."""
    moved = changes_between(data.simulator, finer, fitted.fit, data.segments)
    whitened_fit = whiten_fit(data.times, fitted.fit, noise)
    column = whitened_fit.columns(data.times, moved)[:, 0]
    return float((whitened_fit.residual**2).sum()), Nuisance.of(whitened_fit.slopes).squares_beyond(column)
