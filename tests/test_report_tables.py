"""What a run came to, as a table and as plain data."""

from __future__ import annotations

import json
from io import StringIO
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from equimus_ctrl.plants.mujoco_plant import make_spec
from equimus_ctrl.report.tables import run_table, score_to_dict
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.scenarios.references import HoldReference
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.scenarios.scoring import Score, score_run
from equimus_ctrl.types import Recording, Run

N = 241
TIME = np.arange(N) / 120
REFERENCE = np.tile([1.5, 0.5], (N, 1))


def make_run() -> Run:
    """0.1 rad from the reference at the hip, half the time 0.2 and half the time 0 at the knee."""
    position = REFERENCE + np.stack([np.full(N, 0.1), 0.2 * (np.arange(N) % 2)], axis=1)
    asked = np.tile([10e3, 60e3], (N, 1))
    command = np.clip(asked, 0.0, 50e3)
    solve = np.full(N, 2e-6)
    solve[:20] = 3e-3
    return Run(
        make_spec(nominal_leg(), 1 / 120, None),
        TIME,
        position,
        REFERENCE,
        command,
        asked,
        command != asked,
        solve,
        np.zeros(2),
    )


def make_scenario(**changes: Any) -> Scenario:
    return Scenario("hold", "", 2.0, HoldReference([1.5, 0.5]), score_rate=120.0, **changes)


def recording(name: str = "[real] leg") -> Recording:
    position = REFERENCE + np.array([0.15, 0.1])
    return Recording(name, TIME, np.zeros((N, 2)), position, ("maa", "baa"), ("hip", "knee"))


def printed(score: Score, scenario: Scenario, label: str) -> str:
    out = StringIO()
    Console(file=out, width=80).print(run_table(score, make_run(), scenario, label))
    return out.getvalue()


def test_the_dict_holds_the_right_numbers_in_plain_types() -> None:
    scenario = make_scenario(
        recorded=recording(), published={"hip": 0.0915, "knee": np.float64(0.1748)}, published_controller="pid"
    )
    run = make_run()
    data = score_to_dict(score_run(run, scenario), run, scenario, "pid")
    assert json.loads(json.dumps(data)) == data
    assert list(data) == [
        "scenario",
        "controller",
        "rmse_rad",
        "mae_rad",
        "max_rad",
        "approach",
        "step",
        "arrival",
        "site",
        "recorded",
        "published",
        "window_s",
        "saturated_share",
        "effort_pa",
        "solve_time_s",
        "missing",
    ]
    assert (data["scenario"], data["controller"], data["missing"]) == ("hold", "pid", None)
    assert data["rmse_rad"] == pytest.approx({"hip": 0.1, "knee": 0.2 / 2**0.5}, rel=0.01)
    assert data["mae_rad"] == pytest.approx({"hip": 0.1, "knee": 0.1}, rel=0.01)
    assert data["max_rad"] == pytest.approx({"hip": 0.1, "knee": 0.2})
    assert data["recorded"]["rmse_rad"] == pytest.approx({"hip": 0.05, "knee": 0.1})
    assert data["recorded"]["max_rad"] == pytest.approx({"hip": 0.05, "knee": 0.1})
    assert data["recorded"]["name"] == "[real] leg"
    assert data["published"] == {"rmse_rad": {"hip": 0.0915, "knee": 0.1748}, "controller": "pid"}
    assert data["window_s"] == pytest.approx([0.0, 2.0])
    assert data["saturated_share"] == 0.5
    assert data["effort_pa"] == pytest.approx({"maa": 10e3, "baa": 50e3})
    assert data["solve_time_s"] == pytest.approx({"p50": 2e-6, "p99": 3e-3})


def test_without_a_recording_the_dict_says_so() -> None:
    scenario = make_scenario(missing="fetch them")
    run = make_run()
    data = score_to_dict(score_run(run, scenario), run, scenario, "pid")
    assert data["recorded"] is None
    assert data["published"] is None
    assert data["missing"] == "fetch them"


def test_published_figures_belong_to_one_controller() -> None:
    scenario = make_scenario(published={"hip": 0.0915, "knee": 0.1748})
    run = make_run()
    score = score_run(run, scenario)
    assert score_to_dict(score, run, scenario, "open_loop")["published"]["controller"] == "open_loop"
    assert score_to_dict(score, run, scenario, "pid")["published"] is None
    assert "0.0915" in printed(score, scenario, "open_loop")
    assert "published" not in printed(score, scenario, "pid")


def test_the_table_fits_80_columns_and_holds_the_figures() -> None:
    scenario = make_scenario(recorded=recording(), published={"hip": 0.0915, "knee": 0.1748})
    score = score_run(make_run(), scenario)
    lines = [line.split() for line in printed(score, scenario, "open_loop").splitlines()]
    assert ["hip", "recording", "0.0500", "2.86", "0.0500", "2.86", "0.0500", "2.86", "0.0915"] in lines
    assert ["reference", "0.1000", "5.73", "0.1000", "5.73", "0.1000", "5.73"] in lines
    knee = next(line for line in lines if line[:1] == ["knee"])
    assert knee[1:4] == ["recording", "0.1000", "5.73"]
    assert knee[-1] == "0.1748"
    text = " ".join(word for line in lines for word in line)
    assert "hold, open_loop" in text
    assert "saturated commands 50.0 %" in text
    assert "maa 10.00 kPa, baa 50.00 kPa" in text
    assert "2.0 µs (median), 3.00 ms (99th percentile)" in text
    assert "…" not in text


def test_the_table_keeps_published_figures_off_the_reference() -> None:
    scenario = make_scenario(published={"hip": 0.0915}, missing="no recordings; [fetch] them")
    text = printed(score_run(make_run(), scenario), scenario, "open_loop")
    lines = [line.split() for line in text.splitlines()]
    assert ["hip", "recording", "–", "–", "–", "–", "–", "–", "0.0915"] in lines
    assert next(line for line in lines if line[:1] == ["reference"])[-1] == "5.73"
    assert "no recordings; [fetch] them" in text
