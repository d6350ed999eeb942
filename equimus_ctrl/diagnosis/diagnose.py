"""The whole diagnosis: refit, search, accept only what held-out trials confirm, say what stays unexplained."""

from __future__ import annotations

from dataclasses import replace

from threadpoolctl import threadpool_limits

from equimus_ctrl.diagnosis import stages
from equimus_ctrl.diagnosis.budget import Asked, Budget, never
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.policy import SearchPolicy
from equimus_ctrl.diagnosis.reporting import report
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.state import DiagnosisInputs, forward
from equimus_ctrl.diagnosis.state import DiagnosisSettings as DiagnosisSettings
from equimus_ctrl.diagnosis.state import Progress as Progress
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model


def diagnose(
    free: FreeParameters,
    split: Split,
    *,
    settings: DiagnosisSettings | None = None,
    simulator: Simulator | None = None,
    nominal: Model | None = None,
    progress: Progress = lambda stage, share, best: None,
    asked: Asked = never,
) -> Diagnosis:
    """Find the physics that a model lacks, from recordings.

    Args:
        free: the model and its parameters to estimate.
        split: trials to fit and trials to validate on.
        settings: how it goes.
        simulator: the engine, with no coarser or finer one beside it; see ``engines.choice.engine_for`` for the
            default.
        nominal: the model that was given, for its errors; that of ``free`` by default.
        progress: see ``Progress``.
        asked: whether its best so far is to be given now; asked after each step of a fit.

    Raises:
        SimulationDiverged: where the model diverges on every trial.
        ConfigError: where an effect is to be excluded that is not known, or the budget does not do for the first refit.
        KeyboardInterrupt: where the best so far is asked for before there is any.
    """
    settings = settings or DiagnosisSettings()
    budget = Budget.beginning_now(settings.budget, asked)
    with budget.with_nothing_yet():
        return diagnose_within(budget, free, split, settings, simulator=simulator, nominal=nominal, progress=progress)


def diagnose_within(
    budget: Budget,
    free: FreeParameters,
    split: Split,
    settings: DiagnosisSettings,
    *,
    simulator: Simulator | None = None,
    nominal: Model | None = None,
    progress: Progress = lambda stage, share, best: None,
) -> Diagnosis:
    """The same within a budget that has begun before, in the place of that of the settings.

    Raises:
        SimulationDiverged: where the model diverges on every trial.
        ConfigError: where an effect is to be excluded that is not known.
        BudgetSpent: where the budget ends before the model is refitted.
    """
    _check(settings)
    with threadpool_limits(limits=1, user_api="blas"):  # sums in another order would change the last bits
        if simulator is None:
            data = with_default_engine(free, split, settings)
        else:
            data = _with_engine_given(free, split, simulator)
        data = replace(data, budget=budget, thresholds=settings.thresholds)
        inputs = DiagnosisInputs(data, split, settings, forward(progress), budget.begun, nominal or free.model)
        return report(stages.carried_out(inputs))


def _check(settings: DiagnosisSettings) -> None:
    """Raise ConfigError where settings cannot be used."""
    for name in settings.exclude:
        if name not in REGISTRY:
            raise ConfigError(unknown_name("effect", name, REGISTRY))


def with_default_engine(free: FreeParameters, split: Split, settings: DiagnosisSettings) -> Data:
    """What is fitted, with the engine for the model, and a coarser and a finer one beside it where there are."""
    # Of held-out trials too, which it has to be able to simulate: that looks at poses, and at no error.
    positions = [s.poses for s in (*split.train, *split.validation, *split.test)]
    engine = engine_for(free.model, settings.engine, positions=positions)
    simulator = Simulator(engine, settings.threads)
    others = (engine.coarser(), engine.finer())
    coarse, fine = (None if other is None else replace(simulator, engine=other) for other in others)
    policy = SearchPolicy.of(free.model.robot.traits, engine)
    return Data(free, split.train, simulator, coarse, fine, policy)


def _with_engine_given(free: FreeParameters, split: Split, simulator: Simulator) -> Data:
    """What is fitted, with an engine that is taken for exact and cheap."""
    policy = SearchPolicy.of(free.model.robot.traits, simulator.engine)
    policy = replace(policy, coarse_derivatives=False, rescaled_guesses=False)
    return Data(free, split.train, simulator, policy=policy)
