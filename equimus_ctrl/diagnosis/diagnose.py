"""The whole diagnosis: refit, search, accept only what held-out trials confirm, say what stays unexplained."""

from __future__ import annotations

import math
import time
from dataclasses import replace

from threadpoolctl import threadpool_limits

from equimus_ctrl.diagnosis import stages
from equimus_ctrl.diagnosis.budget import Asked, Budget, BudgetSpent, never
from equimus_ctrl.diagnosis.experiment import Designs
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.policy import SearchPolicy
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.stages import DiagnosisInputs
from equimus_ctrl.diagnosis.stages import DiagnosisSettings as DiagnosisSettings
from equimus_ctrl.diagnosis.stages import Progress as Progress
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.errors import ConfigError, SimulationDiverged, unknown_name
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.simulators import Simulator


def diagnose(
    free: FreeParameters,
    split: Split,
    *,
    settings: DiagnosisSettings | None = None,
    simulator: Simulator | None = None,
    designs: Designs = tuple,
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
        designs: experiments to choose from where effects are not distinguishable.
        progress: see ``Progress``.
        asked: whether its best so far is to be given now; asked after each step of a fit.

    Raises:
        SimulationDiverged: where the model diverges on every trial.
        ConfigError: where an effect is to be excluded that is not known, or the budget does not do for the first refit.
        KeyboardInterrupt: where the best so far is asked for before there is any.
    """
    begun = time.perf_counter()
    settings = settings or DiagnosisSettings()
    if settings.budget is not None and not 0 < settings.budget < math.inf:
        raise ConfigError(f"the budget is {settings.budget:g} s, expected a time above 0")
    budget = Budget(begun + (settings.budget or math.inf), asked)
    for name in settings.exclude:
        if name not in REGISTRY:
            raise ConfigError(unknown_name("effect", name, REGISTRY))
    with threadpool_limits(limits=1, user_api="blas"):  # sums in another order would change the last bits
        if simulator is not None:
            policy = SearchPolicy.of(free.model.robot.traits, simulator.engine)
            # What was handed in is taken for exact and cheap.
            policy = replace(policy, coarse_derivatives=False, rescaled_guesses=False)
            data = Data(free, split.train, simulator, policy=policy, budget=budget, thresholds=settings.thresholds)
        else:
            positions = [s.measured for s in (*split.train, *split.validation, *split.test)]
            engine = engine_for(free.model, settings.engine, positions=positions)
            own, others = Simulator(engine, settings.threads), (engine.coarser(), engine.finer())
            coarse, fine = (None if e is None else replace(own, engine=e) for e in others)
            policy = SearchPolicy.of(free.model.robot.traits, engine)
            data = Data(free, split.train, own, coarse, fine, policy, budget, settings.thresholds)
        inputs = DiagnosisInputs(data, split, settings, designs, progress, begun)
        try:
            left = _worked_out(inputs)
        except BudgetSpent:
            if asked():
                raise KeyboardInterrupt from None
            raise ConfigError(
                f"the budget of {settings.budget:g} s ended before the model was refitted once; expected more time"
            ) from None
        state = stages.or_ended(stages.validation, left)
        if state.rest.unexplained and not left.rest.unexplained and (other := stages.other_inputs(inputs)):
            try:
                second = _reported(stages.or_ended(stages.validation, _worked_out(other)))
            except (SimulationDiverged, BudgetSpent):  # so the first stands
                return _reported(state)
            if not second.unexplained and not second.not_done:
                return stages.on_others(inputs, other, second)
        return _reported(state)


def _worked_out(inputs: DiagnosisInputs) -> stages.State:
    """What is known before held-out trials are asked whether anything is left."""
    state, short = stages.refit(inputs)
    state = stages.search(state, short)
    for stage in (stages.confirmation, stages.unexplained, stages.discretization):
        state = stages.or_ended(stage, state)
    return state


def _reported(state: stages.State) -> Diagnosis:
    return stages.report(stages.or_ended(stages.alternatives, state))
