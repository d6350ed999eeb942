"""What is reported at the end of a diagnosis, of whatever stages it came to; there the test set is simulated, once."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace

from equimus_ctrl.diagnosis.explanations import hidden, left_by, nearest_to, strengths_beside
from equimus_ctrl.diagnosis.findings import beyond_range, findings, named_part, notes, ranking, verdict
from equimus_ctrl.diagnosis.holdout_residuals import HoldoutResiduals
from equimus_ctrl.diagnosis.localization import excess_variances, localise
from equimus_ctrl.diagnosis.noise_size import noise_sizes
from equimus_ctrl.diagnosis.residuals import Residuals
from equimus_ctrl.diagnosis.results import STATES, Diagnosis, Rejected
from equimus_ctrl.diagnosis.smallest_sizes import smallest_sizes
from equimus_ctrl.diagnosis.stages import decided_above_noise, settled, skipped
from equimus_ctrl.diagnosis.state import State
from equimus_ctrl.diagnosis.unexplained import not_on_test
from equimus_ctrl.identification.residuals import residuals_of
from equimus_ctrl.identification.segments import groups_of
from equimus_ctrl.types import Array


def tested(state: State) -> State:
    """Joints whose residuals on the test set alone are far above the noise: told, and nothing is chosen by it."""
    if state.analysis.unexplained or not settled(state):
        return state
    test, best = state.inputs.split.test, state.end.best
    residuals = residuals_of(best.fit.model, test, state.data.simulator)
    analysis = not_on_test(state.data, best, test, residuals)
    return decided_above_noise(replace(state, analysis=analysis), "report", "error on the test set")


def report(state: State) -> Diagnosis:
    """The findings with evidence and intervals, and the rest of the report, which no budget ends."""
    state = tested(state.without_budget())
    inputs, search, end, unexplained = state.inputs, state.search, state.end, state.analysis.unexplained
    data, split, model = state.data, inputs.split, inputs.nominal
    sigma = noise_sizes(data, end.best)[: len(end.best.fit.rmse)]
    holdout, equivalent = HoldoutResiduals(data, split, end), state.equivalent or ()
    told = findings(search, end, holdout, equivalent)
    if state.failed:
        told = tuple(replace(finding, undetermined=state.failed) for finding in told)
    named, undetermined = ([f for f in told if bool(f.undetermined) is side] for side in (False, True))
    for finding in undetermined:
        state = state.decided("report", f"{finding.named} not named", finding.undetermined)
    residuals = _residuals(state, holdout)
    all_named = not (undetermined or unexplained) and settled(state)
    strengths = strengths_beside(search, end, bool(skipped(state))) if all_named else ()
    inputs.progress("done", 1.0, end.best.label)
    return Diagnosis(
        verdict=verdict(named, bool(unexplained or undetermined), settled(state)),
        model=model,
        refitted=end.base.fit.model,
        corrected=end.best.fit.model,
        base=end.base,
        best=end.best,
        train=split.train,
        validation=split.validation,
        test=split.test,
        residuals=residuals,
        sigma=sigma,
        where=localise(model, split.train, end.base.fit.residuals, sigma),
        findings=tuple(named),
        undetermined=tuple(undetermined),
        unexplained=unexplained,
        rejected=_rejected(state),
        ranking=state.ranking or ranking(search, end),
        detectable=smallest_sizes(data.free.model, strengths, search.threshold),
        excess_variance={name: float(excess_variances(residuals[name].train, sigma).mean()) for name in STATES},
        notes=(
            *notes(end, split, inputs.settings.exclude, [stage.decides for stage in skipped(state)]),
            *beyond_range(model, split),
            *([state.coarse] if state.coarse else []),
            *state.notes,
        ),
        seconds=time.perf_counter() - inputs.begun,
        decisions=state.decisions,
        not_done=tuple(stage.name for stage in skipped(state)),
        groups=groups_of((*split.train, *split.validation)),
        differences=state.differences,
        another_unit=state.another_unit,
        explanations=left_by(search, end, equivalent, undetermined),
        nearest=nearest_to(search, end, unexplained),
        below=hidden(search, end, strengths) if all_named else (),
    )


def _rejected(state: State) -> tuple[Rejected, ...]:
    """What stages rejected for good: a later one may have come back to it, or found that it fits as well."""
    stay = {named_part(part) for part in state.end.best.hypothesis}
    stay |= {other.named for others in state.equivalent or () for other in others}
    return tuple({own.named: own for own in state.rejected if own.named not in stay}.values())


def _residuals(state: State, holdout: HoldoutResiduals) -> dict[str, Residuals]:
    """Of each of ``STATES`` on the trials fitted, on those for validation and on those of the test set."""
    end, test, simulator = state.end, state.inputs.split.test, state.data.simulator
    nj = len(state.inputs.data.free.model.robot.joint_names)
    models = state.inputs.nominal, end.base.fit.model, end.best.fit.model

    def of_joints(residuals: Iterable[Array]) -> tuple[Array, ...]:
        return tuple(r[:, :nj] for r in residuals)

    fitted = state.nominal, end.base.fit.residuals, end.best.fit.residuals
    return {
        name: Residuals(*map(of_joints, (train, holdout.residuals(model), residuals_of(model, test, simulator))))
        for name, model, train in zip(STATES, models, fitted, strict=True)
    }
