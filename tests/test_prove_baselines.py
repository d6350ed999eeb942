"""What a worker of a proof does, and the simpler methods that the diagnosis is compared with."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from proof_answers import SAID_LAG, report

from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.effects import make
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.executors.local import OnThisComputer
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.proof import blind
from equimus_ctrl.proof.baselines import TITLES, baselines
from equimus_ctrl.proof.leg_simulation import recordings, simulate
from equimus_ctrl.proof.legs import draw
from equimus_ctrl.proof.seal import seal_of_all
from equimus_ctrl.proof.shares import Share
from equimus_ctrl.proof.sindy_baseline import sparse_regression
from equimus_ctrl.proof.torques import Smooth, missing_torque
from equimus_ctrl.recordings.folders import write_folder
from equimus_ctrl.recordings.sets import read_set
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow import proofs as workflow

# --- a case of its own: what a worker does, and the baselines


def made_case(*effects: tuple[str, str, dict[str, float]], trials: int = 3, duration: float = 4.0) -> list[Recording]:
    """Of the nominal leg, so that nothing but the effects is off."""
    base = draw(1, 4, kind="none", trials=trials, duration=duration)
    concealed = tuple(make(name, where, values) for name, where, values in effects)
    ground_truth = type(base)(**{**vars(base), "robot": nominal_leg(), "effects": concealed})
    return recordings(ground_truth, simulate(ground_truth, 480.0))


@pytest.mark.parametrize("same", [True, False])
def test_a_worker_writes_what_it_finds_and_what_it_took(
    same: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_folder(tmp_path / "case_0003", made_case(trials=2, duration=2.0))
    seen, given = [], []

    def others_say(data: Any, heldout: Any, base: Any) -> dict[str, Any]:
        given.append(base)
        return {"bic": {"findings": [], "failed": ""}}

    def fake(free: Any, data: Any, settings: Any) -> Any:
        seen.append((free.model, [s.trial.name for s in (*data.train, *data.validation, *data.test)], settings.threads))
        return SimpleNamespace(
            to_dict=lambda: {**report(SAID_LAG), "nan": math.nan}, base="fit", train=data.train if same else ()
        )

    monkeypatch.setattr(blind, "diagnose", fake)
    monkeypatch.setattr(blind, "baselines", others_say)
    texts = blind.answer(read_set(tmp_path / "case_0003"), nominal_model(), True, True, False, "sealed")
    assert seen == [(nominal_model(), ["trial_00", "trial_01"], 1)]
    assert given == ["fit" if same else None]  # a fit to other trials is of no use to them
    said, others = (json.loads(text or "") for text in texts)
    assert said["findings"] == [SAID_LAG] and said["nan"] is None
    assert said["proof"]["seal"] == others["seal"] == "sealed"
    assert said["proof"]["fingerprint"] == blind.report_fingerprint() != others["fingerprint"]
    assert said["proof"]["seconds"] > 0 and said["proof"]["peak_memory_byte"] > 10**7


def test_ground_truths_reports_and_truths_come_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def here(executor: OnThisComputer, work: Any, tasks: Any) -> Iterator[tuple[int, Any]]:
        for k, task in enumerate(tasks):
            yield k, work(*task)

    monkeypatch.setattr(OnThisComputer, "each_apart", here)
    said = SimpleNamespace(to_dict=lambda: report(SAID_LAG), base=None)
    monkeypatch.setattr(blind, "diagnose", lambda *a, **k: said)
    options: dict[str, Any] = {"cases": 1, "kind": "none", "trials": 1, "duration": 2.0, "baselines": False}
    found = workflow.prove(tmp_path, **options)
    assert found.score.ours.false_alarms["all"] == Share(1, 1)
    assert found.seal == seal_of_all([(tmp_path / "seals" / "case_0000.txt").read_text().strip()])
    trial = tmp_path / "recordings" / "case_0000" / "trial_00.csv"
    trial.write_text(trial.read_text().replace("\n0.0,", "\n1e-05,", 1))
    with pytest.raises(ConfigError, match="recordings were changed after their truth was sealed"):
        workflow.prove(tmp_path, **options)


def test_a_diagnosis_that_fails_is_an_answer_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_folder(tmp_path / "case", made_case(trials=1, duration=2.0))

    def broken(*_: Any, **__: Any) -> Any:
        raise SimulationDiverged("the model diverges")

    monkeypatch.setattr(blind, "diagnose", broken)
    text, others = blind.answer(read_set(tmp_path / "case"), nominal_model(), True, False, False, "sealed")
    assert others is None and json.loads(text or "")["proof"]["failed"] == "the model diverges"


@pytest.mark.parametrize(
    "concealed",
    [
        ("sensor_scale", "hip", {"scale": 1.05}),
        ("sensor_delay", "knee", {"delay": 0.05}),
        ("payload_mass", "foot", {"mass": 0.1}),
        ("first_order_lag", "maa", {"time_constant": 0.2}),
        ("dead_zone", "baa", {"threshold": 3e3}),
        ("parallel_spring", "knee", {"stiffness": 0.2, "rest": 0.9}),
        ("creep", "baa", {"stiffness": 50.0, "time_constant": 0.5}),
        ("coulomb_friction", "knee", {"friction": 0.03}),
    ],
    ids=lambda c: c[0],
)
def test_the_model_that_is_right_lacks_least_torque(concealed: tuple[str, str, dict[str, float]]) -> None:
    seen = made_case(concealed, trials=1)
    segments = split(nominal_model(), seen).train
    trials = [Smooth.of(segment) for segment in segments]
    instants = [trial.used(nominal_model()) for trial in trials]
    right = Model(nominal_leg(), (make(*concealed),))
    (with_it,), (without,) = (missing_torque(model, trials, instants) for model in (right, nominal_model()))
    assert np.abs(with_it).mean(axis=0).sum() < 0.8 * np.abs(without).mean(axis=0).sum()
    assert len(instants[0]) > 30


@pytest.mark.slow
def test_baselines_name_what_is_plain(monkeypatch: pytest.MonkeyPatch) -> None:
    few = ("sensor_scale", "coulomb_friction", "dead_zone")
    monkeypatch.setattr(
        "equimus_ctrl.proof.baselines.candidates", lambda *a: [c for c in candidates(*a) if c.effect.name in few]
    )
    free = free_parameters(nominal_model())
    data = split(free.model, made_case(("sensor_scale", "hip", {"scale": 1.1})))
    own = Data(free, data.train, reduced_simulator(threads=1))
    found = baselines(own, data.validation)
    assert set(found) == set(TITLES)
    for name in ("bic", "validation"):
        named = {(f["effect"], *f["locations"]) for f in found[name]["findings"]}
        assert ("sensor_scale", "hip") in named, name
        assert not found[name]["failed"] and found[name]["seconds"] > 0
    assert len(found["validation"]["findings"]) == 1


def test_sparse_regression_keeps_columns_within_their_bounds() -> None:
    free = free_parameters(nominal_model())
    seen = made_case(("parallel_spring", "knee", {"stiffness": 0.4, "rest": 0.9}), trials=4)
    segments = split(free.model, seen).train
    pool = [c for c in candidates(free.model, segments) if c.effect.name in ("parallel_spring", "coulomb_friction")]
    found = sparse_regression(free, segments, pool)
    assert ("parallel_spring", "knee") in {(f["effect"], *f["locations"]) for f in found}
    for f in found:
        make(f["effect"], f["locations"][0], {key: own["value"] for key, own in f["parameters"].items()})
