"""Controllers beside each other: the same noise for all, true angles, and what fails stands in its row."""

from __future__ import annotations

import io
import json
import math
import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

import equimus_ctrl as eq
from equimus_ctrl.cli.main import main
from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.plants.events import Load, Push
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.report.comparison import comparison_figures, comparison_table
from equimus_ctrl.scenarios.comparison import Comparison, Condition
from equimus_ctrl.scenarios.references import FunctionReference, HoldReference
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.types import Array, Observation, Reference
from equimus_ctrl.workflow.comparisons import compare, conditions

POSE = np.array([1.45, 0.6])
SHORT = {"duration": "1.5"}


def hold(duration: float = 1.0, **more: object) -> Scenario:
    return Scenario("short_hold", "hold a pose", duration, HoldReference(POSE), **more)  # type: ignore[arg-type]


class Breaks:
    name = "breaks"

    def init(self, spec: object, observation: object) -> None:
        return None

    def step(self, observation: Observation, reference: Reference, state: None) -> tuple[Array, None]:
        if observation.time > 0.5:
            raise ControllerError("it broke")
        return np.full(2, 1e4), None


class Plays:
    """The noise that it sees, told by its commands."""

    def init(self, spec: object, observation: object) -> None:
        return None

    def step(self, observation: Observation, reference: Reference, state: None) -> tuple[Array, None]:
        return 1e4 + 1e3 * observation.position, None


@pytest.fixture(scope="module")
def found() -> Comparison:
    seen: list[tuple[float, str]] = []
    result = compare(
        [hold()], ["pid", "lqr", Breaks, Plays], ["nominal", "noisy"], seed=3, notify=lambda *a: seen.append(a)
    )
    assert [share for share, _ in seen] == sorted(share for share, _ in seen) and seen[-1][0] == 1.0
    assert seen[0][1] == "pid, short_hold, nominal"
    return result


@pytest.mark.slow
def test_every_controller_has_its_row(found: Comparison) -> None:
    named = [(e.condition, e.controller) for e in found.entries]
    assert named == [(c, k) for c in ("nominal", "noisy") for k in ("pid", "lqr", "breaks", "Plays")]
    assert [e.controller for e in found.failures] == ["breaks", "breaks"]
    assert found.failures[0].failure == "it broke"
    record = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert record["entries"][2] == {
        "controller": "breaks", "scenario": "short_hold", "condition": "nominal", "failure": "it broke",
    }  # fmt: skip


def test_errors_are_of_the_true_angles(found: Comparison) -> None:
    entry = next(e for e in found.entries if (e.condition, e.controller) == ("noisy", "lqr"))
    assert entry.run is not None and entry.error is not None and entry.run.truth is not None
    assert entry.score is not None
    inside = entry.run.time <= entry.score.window[1] + 1e-9
    expected = np.sqrt(((entry.run.truth - POSE)[inside] ** 2).mean(axis=0))
    np.testing.assert_allclose(entry.error.rmse, expected, rtol=1e-12)
    assert np.std(entry.run.position - entry.run.truth) == pytest.approx(2e-3, rel=0.2)
    quiet = next(e for e in found.entries if (e.condition, e.controller) == ("nominal", "lqr"))
    assert quiet.run is not None
    np.testing.assert_array_equal(quiet.run.position, quiet.run.truth)


def test_all_see_the_same_noise() -> None:
    one, other = (compare([hold(0.3)], [k], ["noisy"], seed=3).entries[0].run for k in ("lqr", Plays))
    assert one is not None and one.truth is not None and other is not None and other.truth is not None
    np.testing.assert_allclose(one.position - one.truth, other.position - other.truth, atol=1e-12)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_figures() -> None:
    one, other = (compare([hold(0.5)], ["lqr"], ["perturbed"], draws=2, seed=5).to_dict() for _ in range(2))
    for entry in (*one["entries"], *other["entries"]):
        for clock in ("solve_time_s", "deadline_missed_share"):
            del entry[clock]
    assert one == other


def answers(found: Comparison) -> tuple[list[dict[str, object]], list[bytes]]:
    """What runs came to without times of steps, and the bits of their motions."""
    entries = found.to_dict()["entries"]
    for entry in entries:
        for clock in ("solve_time_s", "deadline_missed_share"):
            entry.pop(clock, None)
    runs = [entry.run for entry in found.entries if entry.run is not None]
    return entries, [b"".join(a.tobytes() for a in (r.position, r.truth, r.command)) for r in runs]  # type: ignore[union-attr]


SPRING = """import numpy as np

class Spring:
    name = "spring"

    def init(self, spec, observation):
        return None

    def step(self, observation, reference, state):
        return 1e4 + 1e3 * np.asarray(observation.position), state
"""


@pytest.mark.slow
def test_processes_come_to_the_same_bits_as_one(tmp_path: Path) -> None:
    """Also of a controller that a file defines, which other processes have not loaded."""
    (tmp_path / "spring.py").write_text(SPRING)
    own, seen = f"{tmp_path / 'spring.py'}:Spring", list[tuple[float, str]]()
    given = ([hold(0.3)], ["lqr", own, Breaks], ["perturbed"])
    one = compare(*given, draws=2, seed=5, workers=1)
    two = compare(*given, draws=2, seed=5, workers=2, notify=lambda *a: seen.append(a))
    assert answers(one) == answers(two)
    assert len(one.entries) == 6 and len(set(answers(two)[1])) == 6
    shares = [share for share, _ in seen]
    assert shares == [k / 6 for k in range(7)] and seen[0][1] == "lqr, short_hold, perturbed 1" and seen[-1][1] == ""


@pytest.mark.slow
def test_a_cluster_comes_to_the_same_bits(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    (tmp_path / "spring.py").write_text(SPRING)
    given = ([hold(0.3)], ["lqr", f"{tmp_path / 'spring.py'}:Spring"], ["perturbed"])
    own = distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0")
    with own:
        there = compare(*given, draws=2, seed=5, scheduler=own.scheduler_address)
    assert answers(there) == answers(compare(*given, draws=2, seed=5, workers=1))


def test_what_cannot_be_given_to_another_process_is_driven_by_this_one() -> None:
    class Holds(Plays):
        name = "holds"

        def __init__(self) -> None:
            self.lock, self.processes = threading.Lock(), set[int]()

        def init(self, spec: object, observation: object) -> None:
            self.processes.add(os.getpid())

    controller = Holds()
    assert not compare([hold(0.1)], [controller], ["nominal", "noisy"]).failures
    assert controller.processes == {os.getpid()}
    told = r"controller holds cannot be given to another process \(TypeError: cannot pickle '_thread.lock' object\)"
    with pytest.raises(ConfigError, match=told):
        compare([hold(0.1)], [controller], ["nominal", "noisy"], workers=2)


def test_conditions_are_what_they_say() -> None:
    model = nominal_model()
    own = {c.name: c for c in conditions(["nominal", "noisy", "delayed", "unmodelled_delay"], model)}
    assert own["nominal"].noise == 0 and own["noisy"].noise == 2e-3
    delayed = own["delayed"]
    assert delayed.known == delayed.model and own["unmodelled_delay"].model == delayed.model
    assert own["unmodelled_delay"].known == model
    assert [(e.name, e.location) for e in delayed.model.effects] == [
        ("first_order_lag", "maa"), ("transport_delay", "maa"), ("first_order_lag", "baa"), ("transport_delay", "baa"),
    ]  # fmt: skip
    assert {getattr(e, "time_constant", 0.1) for e in delayed.model.effects} == {0.1}
    assert {getattr(e, "delay", 0.1) for e in delayed.model.effects} == {0.1}
    robots = conditions(["perturbed"], model, draws=4, seed=1)
    assert [c.name for c in robots] == [f"perturbed {k}" for k in (1, 2, 3, 4)]
    nominal = model.morphology.parameters()
    for robot in robots:
        for name, value in robot.model.morphology.parameters().items():
            share = {"damping": 0.4, "rest_length": 0.02}.get(name.rpartition(".")[2], 0.15)
            assert abs(value - nominal[name]) <= share * abs(nominal[name]) + 1e-12, name
        assert robot.known == model
    assert len({r.model.morphology.parameters()["maa.area"] for r in robots}) == 4
    with pytest.raises(ConfigError, match="condition corrected needs a corrected model; give it with --corrected"):
        conditions(["corrected"], model)
    other = Model(model.morphology, delayed.model.effects)
    both = conditions(["corrected", "uncorrected"], model, other)
    assert [c.known for c in both] == [other, model] and [c.model for c in both] == [other, other]


def test_the_table_and_the_figures_show_it_all(found: Comparison, tmp_path: Path) -> None:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(comparison_table(found))
    text = console.export_text()
    for word in ("short_hold", "noisy", "pid", "lqr", "ended early", "breaks, short_hold, noisy: it broke"):
        assert word in text
    figures = comparison_figures(found)
    assert list(figures) == ["errors", "times", "motion_short_hold"]
    assert all(isinstance(f, Figure) for f in figures.values())
    for name, figure in figures.items():
        figure.savefig(tmp_path / f"{name}.png")
    heights = np.asarray(figures["errors"].axes[0].lines[0].get_ydata())
    expected = found.entries[0].error
    assert expected is not None and heights[0] == pytest.approx(1e3 * expected.rmse[0])
    run = found.entries[0].run
    assert run is not None and run.truth is not None
    angles, errors = figures["motion_short_hold"].axes[0], figures["motion_short_hold"].axes[2]
    assert angles.get_ylabel() == "hip [°]" and errors.get_ylabel() == "error [°]"
    drawn = np.asarray(errors.lines[0].get_ydata())
    np.testing.assert_allclose(drawn, np.degrees(run.truth - run.reference)[:, 0], atol=1e-12)


def test_what_compiles_does_so_before_the_steps_that_are_timed() -> None:
    class Compiles(Plays):
        name = "compiles"
        compiled = False

        def step(self, observation: Observation, reference: Reference, state: None) -> tuple[Array, None]:
            if not Compiles.compiled:
                time.sleep(0.3)
                Compiles.compiled = True
            return super().step(observation, reference, state)

    (entry,) = compare([hold(0.3)], [Compiles], ["nominal"]).entries
    assert entry.run is not None and Compiles.compiled and entry.run.solve_time.max() < 0.3


def test_a_push_is_a_torque_for_a_while() -> None:
    """Where a robot rests under a torque is where its statics say."""
    model = nominal_model()
    torque, command = np.array([0.05, -0.03]), np.array([1e4, 5e3])
    plant = MujocoPlant(model, events=[Push(1.0, 5.0, torque)])
    plant.reset(eq.Start(command=command))
    rest = plant.position
    for _ in range(120):
        plant.step(command)
    np.testing.assert_allclose(plant.position, rest, atol=1e-5)
    for _ in range(600):
        plant.step(command)
    kinematics = eq.Kinematics(model.morphology)
    area = np.array([a.area for a in model.morphology.actuators])
    pushed = plant.position
    assert np.abs(pushed - rest).max() > 0.02
    # The same pose under pressures that differ by as much as exerts the torque.
    more = np.linalg.solve(kinematics.jacobian(pushed).T * area, torque)
    np.testing.assert_allclose(kinematics.equilibrium(command + more, pushed), pushed, atol=1e-4)
    for _ in range(600):
        plant.step(command)
    np.testing.assert_allclose(plant.position, rest, atol=1e-4)


def test_a_load_is_a_payload_from_its_time_on() -> None:
    model, command = nominal_model(), np.array([1e4, 5e3])
    plant = MujocoPlant(model, events=[Load(0.5, 0.1), Load(1.0, 0.05)])
    heavy = eq.PayloadMass("foot", 0.15)
    loaded = MujocoPlant(Model(model.morphology, (heavy,)))
    for _ in range(2):  # reset takes the loads off again
        plant.reset(eq.Start(command=command))
        rest = plant.position
        for k in range(900):
            plant.step(command)
            if k == 58:
                np.testing.assert_allclose(plant.position, rest, atol=1e-5)
        loaded.reset(eq.Start(command=command))
        np.testing.assert_allclose(plant.position, loaded.position, atol=1e-4)
        assert np.abs(plant.position - rest).max() > 0.02


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Push(1.0, 0.0, np.zeros(2)), "a push at 1 s lasts 0 s, expected more than 0"),
        (lambda: Push(1.0, 1.0, np.array([math.nan, 0])), r"the torques of a push are \[nan, 0.0\] N·m"),
        (lambda: Load(1.0, -0.1), "a load at 1 s has a mass of -0.1 kg, expected at least 0"),
        (
            lambda: MujocoPlant(nominal_model(), events=[Push(0.0, 1.0, np.zeros(3))]),
            "a push has 3 torques, expected one for each of hip, knee",
        ),
    ],
)
def test_events_that_make_no_sense(make: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make()  # type: ignore[operator]


@pytest.mark.parametrize(
    "name", ["foot_circle", "push", pytest.param("payload", marks=pytest.mark.slow), "unreachable"]
)
def test_the_scenarios_run(name: str) -> None:
    done = eq.run_scenario(name, "pid")
    window = done.run.time >= done.score.window[0]
    assert done.run.truth is not None
    error = np.abs(done.run.truth - done.run.reference)
    if name == "foot_circle":
        kinematics = eq.Kinematics(done.model.morphology)
        feet = np.array([kinematics.foot(q) for q in done.run.reference[window]])
        centre = (feet.max(axis=0) + feet.min(axis=0)) / 2
        np.testing.assert_allclose(np.linalg.norm(feet - centre, axis=1), 0.03, rtol=5e-3)
    elif name in ("push", "payload"):
        before = (done.run.time > 3) & (done.run.time < 4)
        assert error[before].max() < 5e-3 < error[done.run.time > 4].max()
        assert error[-1].max() < 5e-3
    else:
        out = (done.run.time > 5) & (done.run.time < 6.5)
        assert error[out].min(axis=0).max() > 0.1  # nobody gets there
        assert done.run.clipped[out].any() or np.any((done.run.command == 0)[out])


def test_a_reference_that_leaves_the_joint_range_is_told_before_the_run() -> None:
    away = FunctionReference(lambda time: POSE + np.array([0.0, 2.0 * (time > 0.5)]))

    def build(context: object) -> Scenario:
        return Scenario("away", "leaves", 1.0, away)

    from equimus_ctrl.scenarios.scenario import ScenarioContext, build_scenario

    with pytest.raises(ConfigError, match=r"at 0.55 s has knee at 149.0°, outside the joint's range"):
        build_scenario(build, ScenarioContext(eq.nominal_leg()))


@pytest.mark.slow
def test_the_command_writes_prints_and_tells(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "400")  # no line breaks within long paths
    own = tmp_path / "own.py"
    own.write_text("import numpy as np\ndef still(observation, reference):\n    return np.full(2, 1e4)\n")
    arguments = ["compare", "hold", "-c", "pid", "-c", f"{own}:still", "--condition", "nominal", "--json"]
    arguments += ["--set", "duration=0.5", "-o", str(tmp_path / "out")]
    assert main(arguments) == 0
    printed = capsys.readouterr()
    record = json.loads(printed.out)
    assert [e["controller"] for e in record["entries"]] == ["pid", "still"]
    kept = json.loads((tmp_path / "out" / "record.json").read_text())
    assert sorted(kept.pop("files")) == ["errors.png", "motion_hold.png", "times.png"] and kept == record
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "record.json", "errors.png", "times.png", "motion_hold.png",
    }  # fmt: skip
    assert "hold: reach" in printed.err and "still" in printed.err
    own.write_text("def still(observation, reference):\n    return [0.0]\n")
    assert main([*arguments, "--no-figures"]) == 2 and "holds the results" in capsys.readouterr().err
    assert main([*arguments, "--no-figures", "--force"]) == 3
    assert "still returned a command of shape (1,)" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["hold", "--condition", "windy"], "there is no condition 'windy'"),
        (["hold", "-c", "pdi"], "there is no controller 'pdi'; did you mean 'pid'?"),
        (["holt"], "holt"),
        (["hold", "--draws", "0"], "draws is 0, expected at least 1"),
        (["hold", "--condition", "corrected"], "needs a corrected model; give it with --corrected FILE"),
        (["hold", "--settings", "lqr=nowhere.toml"], "nowhere.toml"),
        (["hold", "-c", "pid", "--settings", "lqr=x.toml"], "settings are given for lqr, which is not compared"),
        (
            ["hold", "--workers", "2", "--scheduler", "tcp://head:8786"],
            "expected one: each says where the work is done",
        ),
        (["hold", "--seed", "-1"], "seed is -1, expected at least 0"),
    ],
)
def test_what_is_wrong_is_told_before_the_first_run(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compare", *arguments, "-o", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_condition_of_ones_own() -> None:
    own = Condition("mine", "half the noise", nominal_model(), nominal_model(), 1e-3)
    entry = compare([hold(0.5)], ["lqr"], [own]).entries[0]
    assert entry.condition == "mine" and entry.run is not None and entry.run.truth is not None
    assert np.std(entry.run.position - entry.run.truth) == pytest.approx(1e-3, rel=0.3)
