"""Of recordings that last long, some shooting intervals are fitted, fast and slow ones."""

from __future__ import annotations

import numpy as np
import pytest
from pendulum_runs import MOTOR, PENDULUM

from equimus_ctrl.diagnosis import holdout, intervals
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.intervals import Longest
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording

MODEL = Model(MjcfRobot("arm", PENDULUM.format(drive=MOTOR)))


def still(name: str, seconds: float, quicker: float = 0.0) -> Recording:
    """A pendulum that swings about nothing in particular, by so much quicker each second."""
    time = np.arange(0, seconds, 0.02)
    angle = 0.3 * np.sin((3.0 + quicker / 2 * time) * time)[:, None]
    return Recording(name, time, np.sin(time)[:, None], angle, ("drive",), ("hinge",))


def test_long_recordings_are_thinned_and_none_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(holdout, "MOST_TIME", 20.0)
    trials = [still(f"t{k}", 30.0 if k else 3.0) for k in range(4)]
    parts = split(MODEL, trials, validation=["t3"], shoot=1.0)
    assert parts.of == 63 and 16 <= len(parts.train) <= 22
    by_recording = [[s.trial.start for s in parts.train if s.recording == k] for k in range(3)]
    assert [len(starts) for starts in by_recording] == [1, 8, 8]
    assert len(parts.validation) == 30  # what judges is whole
    inside = {(s.recording, round(s.trial.start)) for s in parts.train}
    assert {(s.recording, int(s.trial.start + 1e-6)) for s in parts.short_segments} <= inside


def test_the_fastest_interval_of_a_recording_is_fitted_and_slower_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(holdout, "MOST_TIME", 10.0)
    parts = split(MODEL, [still("chirp", 40.0, 0.3), still("steady", 3.0)], validation=["steady"], shoot=1.0)
    starts = [round(s.trial.start) for s in parts.train]
    assert len(starts) == 10 and starts[-1] == 39 and set(np.diff(starts)) <= {3, 4, 5}


def test_whole_trials_are_cut_where_they_last_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(holdout, "MOST_TIME", 20.0)
    asked: list[bool] = []
    monkeypatch.setattr(intervals, "longest_interval", lambda *a, whole: asked.append(whole) or Longest(None))
    parts = split(MODEL, [still("a", 40.0), still("b", 40.0)])
    assert asked == [False]
    lengths = [s.trial.sample_times[-1] - s.trial.start for s in parts.train]
    assert max(lengths) <= 8.0 and parts.of > len(parts.train)


def test_what_is_short_is_fitted_whole() -> None:
    parts = split(MODEL, [still("a", 20.0), still("b", 20.0)], shoot=1.0)
    assert parts.of == len(parts.train) == 20
