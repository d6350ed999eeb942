"""What effects with a memory begin with where no recording shows the way before."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from leg_runs import recordings

from equimus_ctrl.diagnosis.diagnose import DiagnosisSettings, diagnose
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.effects import Creep, Hysteresis
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.motion import motion
from equimus_ctrl.engines.predict import measured_start
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.fit import fit
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.residuals import residuals_of
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.types import Recording

MEMORY = Hysteresis("baa", 1.2, 0.008)
NOMINAL = nominal_model()


def trial_of(commands: float = 1e4) -> Trial:
    (recording,) = recordings((), count=1, noise=0.0)
    return Trial.of(replace(recording, command=np.full_like(recording.command, commands)), measured_start(recording))


def test_a_state_begins_with_the_tanh_of_what_is_given_behind_the_start_and_others_as_after_a_rest() -> None:
    model = Model(NOMINAL.robot, (Creep("baa", 20.0, 1.0), Hysteresis("maa", 0.5, 0.01), MEMORY))
    trial = trial_of()
    rest = np.concatenate([trial.position, np.zeros(2)])
    none, first, both = (motion(model, trial, np.append(rest, own)).state[0] for own in ([], [0.4], [0.4, -0.7]))
    assert sorted(both[both != none]) == pytest.approx([np.tanh(-0.7), np.tanh(0.4)], abs=1e-12)
    assert first[first != none] == pytest.approx([np.tanh(0.4)], abs=1e-12)


def test_models_side_by_side_begin_with_what_is_theirs() -> None:
    both = Model(NOMINAL.robot, (Hysteresis("maa", 0.5, 0.01), MEMORY))
    one = Model(NOMINAL.robot, (MEMORY,))
    trial = trial_of()
    rest = np.concatenate([trial.position, np.zeros(2)])
    rows = np.array([[*rest, 0.3, -0.9], [*rest, -0.9, 5.0]])
    together = simulate([both, one], [trial], starts=[rows])[0].position
    alone = [
        simulate([m], [trial], starts=[row[None]])[0].position[0] for m, row in zip((both, one), rows, strict=True)
    ]
    assert np.array_equal(together, alone)
    # A number behind the last one says nothing, and the one of baa is the second of both.
    assert np.array_equal(alone[1], simulate([one], [trial], starts=[rows[1:, :5]])[0].position[0])


@cache
def remembering() -> list[Recording]:
    return recordings((MEMORY,), count=6, noise=5e-4, seed=3, unseen=True)


def test_a_fit_finds_what_each_trial_begins_with_and_trials_held_out_do_so_by_themselves() -> None:
    trials, model = remembering(), Model(NOMINAL.robot, (Hysteresis("baa", 0.5, 0.02),))
    names = [f"{a}.{key}" for a in ("maa", "baa") for key in ("stiffness", "area", "damping")]
    free = free_parameters(model, [*names, "baa.hysteresis.size", "baa.hysteresis.width"])
    segments = [replace(s, may_remember=True) for s in cut(model, trials, fit_start=True)]
    simulator = reduced_simulator()
    found = fit(free, segments[:4], simulator=simulator)
    plain = fit(free, cut(model, trials[:4], fit_start=True), simulator=simulator)
    assert found.rmse == pytest.approx(5e-4, rel=0.1) and np.all(plain.rmse[1] > 2 * found.rmse[1])
    size, width = found.theta[-2:]
    assert size == pytest.approx(MEMORY.size, rel=0.03) and width == pytest.approx(MEMORY.width, rel=0.05)
    began = np.tanh([start[-1] for start in found.starts])
    assert np.ptp(began) > 0.2  # trials begin otherwise
    judged = np.concatenate(residuals_of(found.model, segments[4:], simulator))
    unknown = np.concatenate(residuals_of(found.model, cut(model, trials[4:], fit_start=True), simulator))
    assert np.sqrt(np.mean(judged[:, 1] ** 2)) < 6e-4 < np.sqrt(np.mean(unknown[:, 1] ** 2)) / 2


def told(unseen: bool) -> Diagnosis:
    trials = remembering() if unseen else recordings((MEMORY,), count=6, noise=5e-4, seed=3)
    return diagnose(default_free_parameters(NOMINAL), split(NOMINAL, trials), settings=DiagnosisSettings(threads=2))


@pytest.mark.slow
def test_a_hysteresis_that_remembers_what_nobody_recorded_leaves_nothing_unexplained() -> None:
    found = told(unseen=True)
    assert found.verdict == "explained"
    (finding,) = found.findings
    assert str(finding.named) == "hysteresis at baa"
    assert finding.parameters["size"].value == pytest.approx(MEMORY.size, rel=0.05)
    assert any(d.decision == "each trial begins with a memory of its own" for d in found.decisions)
    assert "Each trial begins with a state of its own of hysteresis at baa: no recording shows the way before." in (
        found.notes
    )
    assert np.all(found.rmse("corrected", "validation") < 6e-4)


@pytest.mark.slow
def test_trials_that_begin_without_a_memory_do_not_get_one() -> None:
    found = told(unseen=False)
    assert [str(f.named) for f in found.findings] == ["hysteresis at baa"]
    assert any(d.decision == "trials begin without a memory" for d in found.decisions)
