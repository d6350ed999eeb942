"""A diagnosis without the error of the engine's physics step: that is no physics, and counts in intervals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from equimus_ctrl.diagnosis.alternatives import without_parts
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.hypothesis import Part
from equimus_ctrl.diagnosis.scoring import extra_parameters
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchHistory, SearchState
from equimus_ctrl.diagnosis.smooth_laws import analysed, analysed_without, without_redundant
from equimus_ctrl.diagnosis.unexplained import ResidualAnalysis
from equimus_ctrl.engines.base import Discretisation
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.noise import Noise
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.identification.step_error import changes_between, with_step_error
from equimus_ctrl.identification.whitened_fit import whiten_fit


@dataclass(frozen=True, eq=False)
class WithoutStepError:
    """A search's end without the discretisation error.

    Attributes:
        search: with the exact engine.
        end: of the search.
        analysis: of the residuals.
        sentence: on the step.
        rejected: what residual forces make redundant then, with the reason.
    """

    search: Search
    end: SearchState
    analysis: ResidualAnalysis
    sentence: str
    rejected: Mapping[Part, str] = field(default_factory=dict)


def without_step_error(
    search: Search, end: SearchState, analysis: ResidualAnalysis, split: Split
) -> WithoutStepError | None:
    """The search's end without the discretisation error, where less physics is missing then.

    A robot's own step belongs to the simulation that the model is compared with, but residuals of its error are no
    physics. None where the engine's discretisation error does not count.

    Args:
        search: with the engine's own step.
        end: of the search.
        analysis: of the residuals.
        split: with the validation trials.

    Raises:
        BudgetSpent: where the budget ends.
        SimulationDiverged: where a hypothesis diverges with the exact engine.
    """
    engine, best = search.data.simulator.engine, end.best
    if (step := engine.discretisation) is None or not (best.hypothesis or analysis.unexplained):
        return None
    simulator = replace(search.data.simulator, engine=engine.without_step_error())
    data = replace(search.data, simulator=simulator, coarse=None)
    uncertain = _parts_of_the_step(search.data, simulator, end)
    if uncertain is None:
        return None
    finely = replace(data, fine=simulator).converge_finely
    exact_best = finely(best)
    needless = [k for k in uncertain if not search.accepts(finely(end.without[k]), exact_best)]
    if not needless and not analysis.unexplained:
        return None
    exact_search = Search(
        data, search.pool, search.settings, fits_with_other_engine=end.tried.fitted, held_out=search.held_out
    )
    base = finely(end.base)
    # Alternatives were fitted with the XML's step, so their likelihoods are not comparable with what follows.
    anew = SearchHistory((base,), first=end.tried.first, rejected=end.tried.rejected)
    start = replace(end, base=base, alternatives=tuple(() for _ in best.hypothesis), tried=anew)
    exact = exact_search.moved(start, exact_best if best.hypothesis else base)
    exact = without_parts(exact_search, exact, needless[:1])
    lost, more = exact.best.deviance - best.deviance, extra_parameters(exact.best, best)
    if search.data.thresholds.decides(lambda t: lost > search.threshold(more, t)):
        return None  # the robot does more as with the XML's step, of which a controller's own may be the reason
    after, rejected = analysed(exact_search, exact, split, analysis.unexplained), dict[Part, str]()
    while after.redundant:
        exact, dropped = without_redundant(exact_search, exact, after)
        rejected |= dropped
        after = analysed_without(exact_search, exact, split, after)
    if not needless and after.unexplained:
        return None
    return WithoutStepError(exact_search, exact, after, _sentence(step), rejected)


def _parts_of_the_step(data: Data, exact: Simulator, end: SearchState) -> list[int] | None:
    """Places of parts that may explain the discretisation error alone; None where neither they nor the error matter.

    Args:
        data: with the engine's own step.
        exact: without its error.
        end: of the search.
    """
    noise, thresholds = end.best.noise, data.thresholds
    try:
        with_all, error = _step_error(data, exact, end.best, noise)
        others = [_step_error(data, exact, fitted, noise) for fitted in end.without]
    except SimulationDiverged:
        return None

    def explains_the_step(without: float, error_without: float) -> bool:
        return thresholds.decides(lambda t: without - with_all < t.step_explains * error_without)

    places = [k for k, (without, error_without) in enumerate(others) if explains_the_step(without, error_without)]
    if not places and thresholds.decides(lambda t: error < t.step_matters * data.n):
        return None
    return places


def _sentence(step: Discretisation) -> str:
    return (
        f"The physics step of the XML, {1e3 * step.step:g} ms, is too long for these recordings: its error would be "
        "taken for missing physics. All of this but the ranking was worked out without that error, from simulations "
        f"with {1e3 * (step.step / step.finer):g} ms too."
    )


def step_counted(data: Data, end: SearchState) -> SearchState:
    """The end with intervals that the error of the engine's physics step is counted in, see ``with_step_error``."""
    engine = data.simulator.engine
    if (step := engine.discretisation) is None:
        return end
    finer, ratio = replace(data.simulator, engine=engine.with_finer_step()), 1 / step.finer

    def counted(fitted: Fitted) -> Fitted:
        fit = with_step_error(fitted.fit, data.segments, data.simulator, finer, ratio, fitted.noise)
        return replace(fitted, fit=fit)

    best = counted(end.best)
    return replace(end, best=best, base=best if end.base is end.best else counted(end.base))


def _step_error(data: Data, finer: Simulator, fitted: Fitted, noise: Noise) -> tuple[float, float]:
    """‖r‖² that a hypothesis leaves, and ‖(I − QQᵀ) Δy‖² of what a finer step changes, both whitened.

    Q spans the Jacobian of the parameters and initial states.

    Raises:
        SimulationDiverged: where the finer simulation does.
    """
    moved = changes_between(data.simulator, finer, fitted.fit, data.segments)
    whitened_fit = whiten_fit(data.times, fitted.fit, noise)
    column = whitened_fit.columns(data.times, moved)[:, 0]
    return float((whitened_fit.residual**2).sum()), Nuisance.of(whitened_fit.slopes).squares_beyond(column)
