"""What the commands do, as a library: models, scenarios, controllers, scores and tuning."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pendulum_runs import MOTOR, PENDULUM, recorded

import equimus_ctrl as eq
from equimus_ctrl import presets, recordings, workflow

COMMANDS = [[10e3, 4e3], [18e3, 4e3], [18e3, 12e3], [6e3, 8e3]]


def made(
    name: str, n: int = 240, offset: Any = 0.0, model: eq.Model | None = None, rate: float = 120.0
) -> eq.Recording:
    """A trial that a model itself would record, ``offset`` (2,) or (n, 2) added to its angles."""
    model = model or eq.nominal_model()
    time = np.arange(n) / rate
    command = np.array(COMMANDS)[np.minimum((time / 0.4).astype(int), 3)]
    start = eq.Kinematics(model.morphology).equilibrium(COMMANDS[0])
    blank = eq.Recording(name, time, command, np.tile(start, (n, 1)), ("maa", "baa"), ("hip", "knee"))
    position = eq.predict(model, blank, start=start) + offset
    return eq.Recording(name, time, command, position, ("maa", "baa"), ("hip", "knee"))


@pytest.fixture(scope="module")
def trial() -> eq.Recording:
    return made("trial")


# Models.


def test_the_nominal_leg_is_the_default() -> None:
    assert workflow.load_model() == eq.nominal_model()


def test_a_model_file_gives_back_what_was_saved(tmp_path: Path) -> None:
    model = eq.Model(
        eq.ideal_leg().with_parameters({"maa.stiffness": 301.5, "gravity": 9.81}), (eq.TransportDelay("baa", 0.1),)
    )
    eq.save_model(tmp_path / "leg.toml", model)
    assert eq.load_model(tmp_path / "leg.toml") == model
    assert eq.load_model(str(tmp_path / "leg.toml")) == model


def test_a_wrong_model_file_is_a_sentence_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "leg.toml"
    path.write_text('morphology = "nominal_log"\n')
    with pytest.raises(eq.ConfigError) as caught:
        eq.load_model(path)
    assert str(caught.value).startswith(f"{path}: there is no morphology 'nominal_log'; did you mean 'nominal_leg'?")


# Scores.


def test_a_model_scores_nothing_against_itself(trial: eq.Recording) -> None:
    score = eq.score([trial])
    np.testing.assert_allclose(score.rmse, 0.0, atol=1e-12)
    assert len(score.trials) == 1 and score.trials[0].samples == 240
    np.testing.assert_allclose(score.trials[0].predicted, trial.position, atol=1e-12)


def test_both_engines_agree(trial: eq.Recording) -> None:
    score = eq.score([trial], engine="mujoco")
    assert np.all(score.rmse < 1e-5)


def test_errors_are_pooled_over_samples() -> None:
    """Noise that begins after the start: trials of unlike length weigh by their samples."""
    late = np.zeros((240, 2))
    late[100:] = [0.03, -0.01]
    short = np.zeros((60, 2))
    short[30:] = [0.0, 0.02]
    score = eq.score([made("a", offset=late), made("b", 60, offset=short)])
    one, two = (t.rmse for t in score.trials)
    np.testing.assert_allclose(one, np.array([0.03, 0.01]) * math.sqrt(140 / 240), atol=1e-9)
    np.testing.assert_allclose(two, np.array([0.0, 0.02]) * math.sqrt(30 / 60), atol=1e-9)
    pooled = [0.03**2 * 140 / 300, (0.01**2 * 140 + 0.02**2 * 30) / 300]
    np.testing.assert_allclose(score.rmse, np.sqrt(pooled), atol=1e-9)
    assert [t.samples for t in score.trials] == [240, 60]


def test_each_trial_starts_from_its_own_measured_start() -> None:
    """A leg that does not rest where the model would still is predicted from where it was."""
    other = eq.Model(eq.nominal_leg().with_parameters({"maa.area": 0.00042}))
    moved = made("moved", model=other)
    score = eq.score([moved])
    np.testing.assert_allclose(score.trials[0].predicted[0], moved.position[0], atol=1e-12)
    assert np.all(eq.score([moved], other).rmse < 1e-10)
    assert np.all(score.rmse > 1e-3)


def test_noise_does_not_decide_where_a_robot_begins_that_may_move(tmp_path: Path) -> None:
    """The right model of a free pendulum is off by the noise, which velocities of noisy positions would hide."""
    (tmp_path / "arm.xml").write_text(PENDULUM.format(drive=MOTOR))
    arm, noise = eq.load_model(tmp_path / "arm.xml"), 4e-3
    trials = recorded(arm, noise=noise)
    trials[1] = replace(trials[1], notes={"settled": "no"})  # each row counts all the same
    found = eq.score(trials, arm)
    assert found.start == "fitted" and found.rmse[0] == pytest.approx(noise, rel=0.06)
    assert [score.samples for score in found.trials] == [len(trial.time) for trial in trials]
    measured = eq.score(trials, arm, start="measured")
    assert measured.start == "measured" and measured.rmse[0] > 2 * noise
    np.testing.assert_allclose(measured.trials[0].predicted, eq.predict(arm, trials[0]), atol=1e-12)


def test_a_fitted_start_of_a_leg_is_what_its_effects_remember() -> None:
    """A hysteresis that was moved before the recording: unknown, and found from the recording itself."""
    real = eq.Model(eq.nominal_leg(), (eq.Hysteresis("baa", 1.2, 0.008),))
    before = np.array([[25e3, 1e3], [2e3, 20e3]])
    whole = made("whole", model=real)
    command = np.concatenate([np.repeat(before, 60, axis=0), whole.command])
    time = np.arange(len(command)) / 120
    blank = eq.Recording("t", time, command, np.zeros_like(command), ("maa", "baa"), ("hip", "knee"))
    angles = eq.predict(real, blank, start=eq.Kinematics(eq.nominal_leg()).equilibrium(before[0]))
    late = slice(100, None)
    trial = eq.Recording("t", time[late] - time[100], command[late], angles[late], ("maa", "baa"), ("hip", "knee"))
    measured, fitted = (eq.score([trial], real, start=start).rmse for start in ("measured", "fitted"))
    assert np.all(fitted < measured)


def test_a_window_and_a_grid() -> None:
    late = np.zeros((240, 2))
    late[120:] = 0.05
    recorded = made("a", offset=late)
    early, end = (eq.score([recorded], window=w) for w in ((0.0, 0.9), (1.0, 9.0)))
    np.testing.assert_allclose(early.rmse, 0.0, atol=1e-9)
    np.testing.assert_allclose(end.rmse, 0.05, atol=1e-9)
    assert early.trials[0].samples == 109 and end.trials[0].samples == 120
    grid = eq.score([recorded], window=(1.0, 1.5), rate=20.0)
    assert grid.trials[0].samples == 11
    np.testing.assert_allclose(grid.rmse, 0.05, atol=1e-9)
    assert eq.score([recorded], rate=120.0).trials[0].samples == 240


def test_files_folders_and_lists_do_the_same(tmp_path: Path, trial: eq.Recording) -> None:
    for name in ("one", "two"):
        recordings.write(tmp_path / f"{name}.csv", trial)
    both = [tmp_path / "one.csv", str(tmp_path / "two.csv")]
    scores = [eq.score(given) for given in (tmp_path, str(tmp_path), both, [trial, trial])]
    for score in scores:
        assert len(score.trials) == 2
        np.testing.assert_allclose(score.rmse, scores[0].rmse, atol=1e-12)
    assert [t.recording.name for t in scores[0].trials] == ["one", "two"]
    assert len(eq.score(tmp_path / "one.csv").trials) == 1


def test_the_score_as_plain_types(trial: eq.Recording) -> None:
    shares: list[float] = []
    found = eq.score([trial, trial], progress=shares.append).to_dict()
    assert shares == [0.5, 1.0]
    assert set(found) == {"model", "engine", "start", "rmse_rad", "trials"} and found["model"] == "nominal_leg"
    assert found["start"] == "measured"
    assert found["engine"] == {"name": "reduced", "reason": ""}
    assert set(found["rmse_rad"]) == {"hip", "knee"}
    assert [set(t) for t in found["trials"]] == [{"name", "start", "rmse_rad"}] * 2
    assert json.loads(presets.json_text(found)) == found


def test_the_concealed_leg_without_anything_left_out(recordings_dir: Path) -> None:
    """Made by another program from the nominal leg and 1.8 mrad of noise."""
    folder = recordings_dir / "concealed" / "open_1"
    if not folder.is_dir():
        pytest.skip("no concealed recordings here")
    score = eq.score(folder)
    assert len(score.trials) == 8 and np.all(score.rmse <= 0.0020) and np.all(score.rmse > 0.0017)


@pytest.mark.parametrize(
    ("window", "rate", "sentence"),
    [
        ((90.0, 99.0), None, "trial: has no samples between 90 and 99 s; it lasts from 0 to 1.99167 s"),
        ((1.0, 0.5), None, "trial: has no samples between 1 and 0.5 s"),
        ((90.0, 99.0), 10.0, "trial: has no samples between 90 and "),
        ((0.501, 0.502), None, "trial: has no samples between 0.501 and 0.502 s"),
    ],
)
def test_a_window_without_samples_is_a_sentence(
    window: tuple[float, float], rate: float | None, sentence: str, trial: eq.Recording
) -> None:
    with pytest.raises(eq.ConfigError) as caught:
        eq.score([trial], window=window, rate=rate)
    assert str(caught.value).startswith(sentence)


@pytest.mark.parametrize("rate", [0.0, -5.0, math.nan, math.inf])
def test_a_rate_that_cannot_be_is_a_sentence(rate: float, trial: eq.Recording) -> None:
    with pytest.raises(eq.ConfigError, match="rate"):
        eq.score([trial], rate=rate)


def test_nothing_to_score_is_a_sentence() -> None:
    with pytest.raises(eq.EquimusError, match="recording"):
        eq.score([])


def test_trials_and_files_may_be_mixed(tmp_path: Path, trial: eq.Recording) -> None:
    recordings.write(tmp_path / "one.csv", trial)
    assert len(eq.score([trial, tmp_path / "one.csv"]).trials) == 2  # type: ignore[list-item]


def test_another_robots_recording_is_a_sentence(trial: eq.Recording) -> None:
    other = eq.Recording("arm", trial.time, trial.command, trial.position, ("maa", "baa"), ("hip", "elbow"))
    with pytest.raises(eq.ConfigError, match=r"arm: has joints hip, elbow .* but the model nominal_leg has hip, knee"):
        eq.score([trial, other])
    with pytest.raises(eq.ConfigError, match="there is no engine 'fast' .known: mujoco, reduced"):
        eq.score([trial], engine="fast")  # type: ignore[arg-type]


# Runs.


def test_a_run_by_names(tmp_path: Path) -> None:
    shares: list[float] = []
    done = eq.run_scenario("hold", options={"duration": "0.2"}, recordings=tmp_path, progress=shares.append)
    assert (done.controller, done.plant, done.model.name) == ("pid", "mujoco", "nominal_leg")
    assert shares[-1] == 1.0 and len(done.run.time) == 24 and done.score.recorded is None


def test_effects_are_added_to_the_models_own(tmp_path: Path) -> None:
    """Each pressure alone is late: the angles are those of a model that had both from the start."""
    options, own = {"duration": "0.4"}, eq.TransportDelay("maa", 0.05)
    added = eq.FirstOrderLag("baa", 0.1)
    kwargs: dict[str, Any] = {"options": options, "recordings": tmp_path}
    leg = eq.nominal_leg()
    one = eq.run_scenario("chirp", model=eq.Model(leg, (own,)), effects=[added], **kwargs)
    two = eq.run_scenario("chirp", model=eq.Model(leg, (own, added)), **kwargs)
    bare = eq.run_scenario("chirp", model=eq.Model(leg), **kwargs)
    np.testing.assert_array_equal(one.run.position, two.run.position)
    assert np.abs(one.run.position - bare.run.position).max() > 1e-4
    assert one.model.effects == (own, added)


def test_a_controller_knows_the_model_but_not_what_is_added(tmp_path: Path) -> None:
    """An effect added is a surprise to it, one of the model is none, and so is one of what it is said to know."""
    late, other = eq.TransportDelay("maa", 0.2), eq.Model(eq.nominal_leg().with_parameters({"maa.stiffness": 250.0}))
    seen: list[eq.PlantSpec] = []

    def watching(observation: eq.Observation, reference: eq.Reference, spec: eq.PlantSpec) -> Any:
        seen.append(spec)
        return np.zeros(2)

    kwargs: dict[str, Any] = {"options": {"duration": "0.1"}, "recordings": tmp_path}
    for given in ({"effects": [late]}, {"model": eq.Model(eq.nominal_leg(), (late,))}, {"nominal": other}):
        eq.run_scenario("hold", watching, **given, **kwargs)
    first, own, told = seen[0], seen[12], seen[24]
    assert first.effects == () and first.model == eq.nominal_leg()
    assert own.effects == (late,) and told.model == other.morphology


def test_noise_and_its_seed(tmp_path: Path) -> None:
    runs = [
        eq.run_scenario("hold", options={"duration": "0.3"}, recordings=tmp_path, noise=noise, seed=seed).run
        for noise, seed in ((0.0, 1), (0.002, 1), (0.002, 1), (0.002, 2))
    ]
    assert np.array_equal(runs[1].position, runs[2].position)
    assert not np.array_equal(runs[1].position, runs[3].position)
    assert (runs[1].position - runs[0].position)[:5].std() == pytest.approx(0.002, rel=0.8)


def test_a_replayed_recording_is_what_was_recorded(leg_dir: Path) -> None:
    done = eq.run_scenario("triangle", plant="replay", recordings=leg_dir, options={"duration": "12"})
    assert done.score.recorded is not None and done.score.window[1] > 11.9
    # Only the hold between samples is left: the plant shows the latest row, the grid lies between rows.
    assert np.all(done.score.recorded.rmse < 0.03)
    np.testing.assert_array_equal(done.run.position[0], done.scenario.recorded.position[0])  # type: ignore[union-attr]


def test_the_whole_triangle_can_be_replayed(leg_dir: Path) -> None:
    done = eq.run_scenario("triangle", plant="replay", recordings=leg_dir)
    assert done.score.window[1] > 39.9


def test_effects_on_a_replay_are_refused(leg_dir: Path) -> None:
    with pytest.raises(eq.EquimusError, match="replay"):
        eq.run_scenario(
            "triangle",
            plant="replay",
            recordings=leg_dir,
            effects=[eq.TransportDelay("baa", 0.1)],
            options={"duration": "0.5"},
        )


@pytest.mark.parametrize(
    ("changes", "kind", "sentence"),
    [
        (
            {"plant": "mojoco"},
            eq.ConfigError,
            "there is no plant 'mojoco'; did you mean 'mujoco'? (known: hardware, mujoco, re",
        ),
        ({"plant": "replay"}, eq.NotAvailable, "the replay plant plays the scenario's recording, and there is none"),
        ({"noise": -1.0}, eq.ConfigError, "noise is -1 rad or m, expected 0 to 1"),
        ({"controller": "PID"}, eq.ControllerError, "there is no controller 'PID'"),
        ({"controller": "nowhere.py:X"}, eq.ConfigError, "nowhere.py: there is no such file"),
        ({"effects": [eq.TransportDelay("hip", 0.1)]}, eq.ConfigError, "nominal_leg: effect transport_delay: there is"),
        ({"settings": Path("nowhere.toml")}, eq.ConfigError, "nowhere.toml: there is no such file"),
    ],
)
def test_a_wrong_run_is_a_sentence(
    changes: dict[str, Any], kind: type[Exception], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(kind) as caught:
        eq.run_scenario("hold", recordings=tmp_path, **changes)
    assert str(caught.value).startswith(sentence)


def test_a_negative_seed_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(eq.ConfigError, match="seed"):
        eq.run_scenario("hold", recordings=tmp_path, noise=0.001, seed=-1, options={"duration": "0.1"})


@pytest.mark.parametrize("controller", ["open_loop", "example"])
def test_settings_for_a_controller_without_any_are_refused(controller: str, tmp_path: Path) -> None:
    if controller == "example":
        controller = f"{presets.find('controllers', 'example_custom.py')}:Spring"
    presets.write_text(tmp_path / "s.toml", "[gains.maa]\nkp = 1\n")
    with pytest.raises(eq.EquimusError, match="settings"):
        eq.run_scenario(
            "hold", controller, recordings=tmp_path, settings=tmp_path / "s.toml", options={"duration": "0.1"}
        )


def test_settings_of_ones_own(tmp_path: Path) -> None:
    """Without gains the PID is its feed-forward."""
    presets.write_text(tmp_path / "s.toml", "start_time = 0\n[gains.maa]\nkp = 0\n[gains.baa]\nkp = 0\n")
    options = {"duration": "0.1", "hip": "85", "knee": "25"}
    done = eq.run_scenario("hold", "pid", recordings=tmp_path, settings=tmp_path / "s.toml", options=options)
    static = eq.Kinematics(eq.nominal_leg()).static_pressure(np.radians([85, 25]))
    start = eq.Kinematics(eq.nominal_leg()).static_pressure(done.run.position[0])
    np.testing.assert_allclose(done.run.command[1], static - start, atol=1.0)


def test_the_plant_is_closed_whatever_happens(tmp_path: Path) -> None:
    closed: list[bool] = []

    class Closing(eq.MujocoPlant):
        def close(self) -> None:
            closed.append(True)

    plant = Closing(eq.nominal_model())
    scenario = workflow.load_scenario("hold", eq.nominal_leg(), options={"duration": "0.1"}, recordings=tmp_path)
    eq.run_scenario(scenario, plant=plant)
    with pytest.raises(eq.ControllerError):
        eq.run_scenario(scenario, lambda observation, reference: [math.nan, 0.0], plant=plant)
    assert closed == [True, True]


# Tuning.


STUDY = {
    "seed": 5,
    "candidates": 3,
    "objectives": [{"scenario": "hold", "duration": 2.5}],
    "limits": {"overshoot": 0.6},
    "ensemble": {"members": 2, "unseen": 1, "delay": [0.0, 0.02], "lag": [0.02, 0.04]},
    "search": {
        "kp": {"low": 5.0, "high": 3000.0, "start": 150.0},
        "ki": {"low": 5.0, "high": 5000.0, "start": 200.0},
        "kd": {"low": 0.2, "high": 200.0, "start": 5.0},
        "derivative_time": {"low": 0.005, "high": 0.1, "start": 0.02},
    },
}


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small study in a current folder of our own."""
    monkeypatch.chdir(tmp_path)
    presets.write_text(tmp_path / "small.toml", presets.toml_text(STUDY))
    return tmp_path / "small.toml"


def test_tuning_writes_where_it_says(study: Path, tmp_path: Path) -> None:
    totals: list[int] = []
    told: list[Any] = []
    tuned = workflow.tune_into("pid", study, begin=totals.append, notify=told.append)
    assert totals == [3] and len(told) == 3 and tuned.reused == 0
    assert tuned.settings == tmp_path / "controllers" / "pid.toml"
    assert tuned.folder == tmp_path / "tuning" / "results" / "small"
    assert tuned.record == tuned.folder / "record.json"
    assert sorted(p.name for p in tuned.folder.iterdir()) == ["journal.jsonl", "pid.toml", "record.json"]
    assert eq.PidSettings.from_dict(presets.read_toml(tuned.settings)) == tuned.result.settings
    comment = tuned.settings.read_text().split("\n\n")[0]
    assert comment.count("\n") == 1 and all(line.startswith("# ") for line in comment.split("\n"))
    assert "small" in comment and "seed 5" in comment and "3 sets of gains" in comment and "N and m" in comment
    done = eq.run_scenario("hold", "pid", settings=tuned.settings, options={"duration": "0.1"}, recordings=tmp_path)
    assert np.isfinite(done.run.command).all()


def test_tuned_again_it_asks_nothing_twice(study: Path) -> None:
    one = workflow.tune_into("pid", study)
    two = workflow.tune_into("pid", study)
    assert two.reused == 3 and two.result.settings == one.result.settings
    assert all(trial.reused for trial in two.result.history)
    fresh = workflow.tune_into("pid", study, fresh=True)
    assert fresh.reused == 0 and (fresh.folder / "journal-1.jsonl").exists()
    assert len((fresh.folder / "journal-1.jsonl").read_text().splitlines()) == 4


@pytest.mark.slow
def test_another_tuning_leaves_what_is_there(study: Path, tmp_path: Path) -> None:
    one = workflow.tune_into("pid", study)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    other = workflow.tune_into("pid", study, seed=6)
    assert one.left is None and other.left == one.settings and other.reused == 0
    assert other.folder.name == "small-2" and other.settings == other.folder / "pid.toml"
    assert eq.PidSettings.from_dict(presets.read_toml(other.settings)) == other.result.settings
    assert {path: path.read_bytes() for path in before} == before
    assert workflow.tune_into("pid", study, seed=6).folder == other.folder, "it is found again"
    (tmp_path / "mine.toml").write_text("[gains]\n")
    with pytest.raises(eq.ConfigError, match=r"mine.toml: is there already; expected another name, or --force"):
        workflow.tune_into("pid", study, output=tmp_path / "mine.toml")
    with pytest.raises(eq.ConfigError, match=r"small: holds another tuning, of other settings or another model"):
        workflow.tune_into("pid", study, seed=7, folder=one.folder)
    edited = other.settings.read_text().replace("kp = ", "kp = 1")
    other.settings.write_text(edited)
    beside = workflow.tune_into("pid", study, seed=6)
    assert other.settings.read_text() == edited, "it was edited since"
    assert eq.PidSettings.from_dict(presets.read_toml(other.folder / "pid-2.toml")) == beside.result.settings
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "pid.toml").write_text("[gains]\n")
    theirs = workflow.tune_into("pid", study, seed=6, folder=tmp_path / "empty", output=tmp_path / "out.toml")
    assert (tmp_path / "empty" / "pid.toml").read_text() == "[gains]\n" and theirs.settings == tmp_path / "out.toml"
    other.settings.unlink()
    forced = workflow.tune_into("pid", study, seed=6, force=True)
    assert (forced.folder, forced.settings, forced.left) == (one.folder, one.settings, None)
    assert forced.settings.read_bytes() == beside.settings.read_bytes()


def test_tuned_settings_are_not_lost_with_a_full_disk(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Where the results' disk is full, the settings are written all the same, and the message says where."""
    write = presets.write_bytes

    def full(path: Path, data: bytes) -> None:
        if "results" in path.parts and path.name != "journal.jsonl":
            raise eq.ConfigError(f"{path}: cannot be written (No space left on device)")
        write(path, data)
        if path.name == "journal.jsonl":
            path.unlink()
            path.symlink_to("/dev/full")

    monkeypatch.setattr(presets, "write_bytes", full)
    with pytest.raises(eq.ConfigError, match=r"No space left on device.*; the settings are in .*controllers/pid.toml"):
        workflow.tune_into("pid", study)
    assert presets.read_toml(tmp_path / "controllers" / "pid.toml")["gains"]
    (told,) = {record.getMessage() for record in caplog.records if "journal.jsonl" in record.getMessage()}
    assert "cannot be written any more (No space left on device)" in told


def test_options_take_the_place_of_the_studys(study: Path, tmp_path: Path) -> None:
    tuned = workflow.tune_into(
        "pid",
        study,
        candidates=2,
        seed=9,
        scenarios=["hold"],
        model=eq.Model(eq.nominal_leg(), (eq.TransportDelay("baa", 0.02),)),
        output=tmp_path / "out" / "mine.toml",
        folder=tmp_path / "else",
        workers=1,
    )
    assert (tuned.result.study.candidates, tuned.result.study.seed) == (2, 9)
    assert [o.duration for o in tuned.result.study.objectives] == [None]
    assert tuned.settings == tmp_path / "out" / "mine.toml" and tuned.settings.exists()
    assert tuned.folder == tmp_path / "else" and not (tmp_path / "tuning").exists()
    assert not (tmp_path / "controllers").exists()
    assert tuned.result.problem.members[0].valve[1, 0] == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("changes", "kind", "sentence"),
    [
        ({"candidates": 0}, eq.ConfigError, "study: candidates is 0, expected 1 to 1e+06"),
        ({"seed": -1}, eq.ConfigError, "study: seed is -1, expected at least 0"),
        ({"scenarios": ["hodl"]}, eq.ConfigError, "there is no scenario 'hodl'; did you mean 'hold'?"),
        ({"study": Path("nowhere.toml")}, eq.ConfigError, "nowhere.toml: there is no such file"),
        ({"recordings": Path("nowhere"), "scenarios": ["triangle"]}, eq.RecordingError, "--recordings: nowhere does n"),
    ],
)
def test_a_wrong_tuning_is_a_sentence_and_writes_nothing(
    changes: dict[str, Any], kind: type[Exception], sentence: str, study: Path, tmp_path: Path
) -> None:
    with pytest.raises(kind) as caught:
        workflow.tune_into("pid", **{"study": study, **changes})
    assert sentence in str(caught.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["small.toml"]


def test_nothing_feasible_writes_no_settings(study: Path, tmp_path: Path) -> None:
    from equimus_ctrl.errors import NothingFeasible

    presets.write_text(study, presets.toml_text({**STUDY, "limits": {"overshoot": 0.0, "modulus": 0.5}}))
    (tmp_path / "controllers").mkdir()
    (tmp_path / "controllers" / "pid.toml").write_text("# mine\n")
    with pytest.raises(NothingFeasible, match="none of 3 sets of gains is stable and within the limits on every leg"):
        workflow.tune_into("pid", study)
    assert (tmp_path / "controllers" / "pid.toml").read_text() == "# mine\n"
    assert not (tmp_path / "tuning" / "results" / "small" / "record.json").exists()


def test_without_a_study_anywhere_it_is_a_sentence(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(presets, "find", lambda kind, file: None)
    with pytest.raises(eq.ConfigError, match=r"there is no tuning/any.toml; name a study with --study"):
        workflow.tune_into("pid")
