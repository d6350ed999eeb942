"""The proof of MJCF robots: ground truths that are what they are said to be, made by other code than the diagnosis uses."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from equimus_ctrl.cli.main import main
from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.effects import GravityTilt
from equimus_ctrl.effects.base import REGISTRY, Effect
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.proof import store
from equimus_ctrl.proof.designs import TrialDesign
from equimus_ctrl.proof.drawing import Excess, GroundTruth, noise
from equimus_ctrl.proof.mjcf import Experiment
from equimus_ctrl.proof.mjcf_simulation import (
    EXACT,
    FINER,
    Stepped,
    mjcf_excess,
    mjcf_recordings,
    simulate_mjcf_truth,
    trials_of,
)
from equimus_ctrl.proof.outside import OUTSIDE
from equimus_ctrl.proof.sizes import mjcf_table
from equimus_ctrl.proof.store import Request
from equimus_ctrl.types import Array, Recording
from equimus_ctrl.workflow.models import load_model
from equimus_ctrl.workflow.proofs import far_beyond
from equimus_ctrl.workflow.scores import gather

EXAMPLES = Path(__file__).resolve().parents[1] / "docs" / "examples"
TWO = Path(__file__).resolve().parents[1] / "benchmarks" / "real_machines" / "double_pendulum_c1.xml"
ALIKE = 2e-3
"""Of what a joint covers: so far apart two ways to step the same laws may be, whose steps are alike."""


@pytest.fixture(scope="module")
def pendulum() -> Experiment:
    """The pendulum of the documents with half of what was recorded of it."""
    model = load_model(EXAMPLES / "pendulum.xml")
    return Experiment(model, tuple(gather(EXAMPLES / "pendulum", model)[:2]))


@pytest.fixture(scope="module")
def two_joints() -> Experiment:
    """A double pendulum, two trials of two seconds."""
    model = load_model(TWO)
    robot, rng = model.robot, np.random.default_rng(3)
    time = np.arange(0, 2, 0.01)
    trials = []
    for k in range(2):
        torque = np.sin(2 * np.pi * rng.uniform(0.3, 1.5, 2) * time[:, None] + k) * (1.2, 0.6)
        angles = np.zeros((200, 2)) + rng.uniform(-0.5, 0.5, 2)
        still = Recording(f"run_{k}", time, torque, angles, robot.actuator_names, robot.joint_names)
        (found,) = simulate_mjcf([model], trials_of(_ground_truth(model, (still,), ())), threads=1)
        trials.append(replace(still, position=found.position[0]))
    return Experiment(model, tuple(trials))


def _ground_truth(model: Model, recordings: tuple[Recording, ...], effects: tuple[Effect, ...]) -> GroundTruth:
    trials = [
        TrialDesign(r.name, "as recorded", r.time, r.command, np.array(r.position[0]), r.notes) for r in recordings
    ]
    noise = (1e-3,) * len(model.robot.joints)
    return GroundTruth(
        0, 0, "single", model.robot, effects, (), noise, 0.0, tuple(trials), np.zeros((len(recordings), 0))
    )


def bare(model: Model) -> Model:
    """Without armatures, which some of the physics that may be missing take the place of."""
    return model.with_parameters({name: 0.0 for name in model.parameters() if name.endswith(".armature")})


NOT_DRAWN = {"plane_contact"}
"""No share of what recordings show keeps a plane below where every trial begins, and above where it does nothing."""
OF_MJCF_ROBOTS = sorted(name for name, cls in REGISTRY.items() if "mjcf" in cls.robots and name not in NOT_DRAWN)


def test_there_is_a_size_for_every_effect_of_mjcf_robots(two_joints: Experiment) -> None:
    model = bare(two_joints.model)
    table = mjcf_table(model, excitation_of(model, two_joints.segments))
    own = set(OF_MJCF_ROBOTS)
    assert own <= set(table) <= own | set(OUTSIDE)
    for name, sizes in table.items():
        info = {**REGISTRY, **OUTSIDE}[name].parameter_info()
        for place in {size.at for size in sizes}:
            assert sorted(size.parameter for size in sizes if size.at == place) == sorted(info)
        assert all(size.low < size.high for size in sizes)


def without_steps(model: Model, trials: Sequence[Trial]) -> list[Array]:
    """What the diagnosis' engine says of a step of nothing, from two."""
    dt = model.robot.timestep / FINER
    fine, coarse = (simulate_mjcf([model], trials, dt=step, threads=1) for step in (dt, 2 * dt))
    return [2 * a.position[0] - b.position[0] for a, b in zip(fine, coarse, strict=True)]


@pytest.mark.parametrize("name", OF_MJCF_ROBOTS)
def test_both_ways_to_step_an_effect_agree(name: str, two_joints: Experiment) -> None:
    model, cls = two_joints.model, REGISTRY[name]
    seen = excitation_of(model, two_joints.segments)
    table = mjcf_table(model, seen)
    if name not in table:
        model = bare(model)
        table = mjcf_table(model, seen)
    sizes = table[name]
    rows = [size for size in sizes if size.at == sizes[0].at]
    rng = np.random.default_rng(1)
    for _ in range(50):
        try:
            effect = cls(rows[0].at, **{row.parameter: row.draw(rng) for row in rows})
            real = Model(model.robot, (effect,))
            break
        except ConfigError:
            continue
    ground_truth = _ground_truth(model, two_joints.recordings[:1], real.effects)
    stepped, (trial,) = Stepped(ground_truth), trials_of(ground_truth)
    # Steps that both can take: how far errors of steps grow along this trial is another matter.
    own = 2 * stepped.done(trial, FINER).shown - stepped.done(trial, FINER // 2).shown
    (other,), (without,) = (without_steps(m, [trial]) for m in (real, model))
    apart, does = np.abs(own - other).max(), np.abs(own - without).max()
    assert apart < max(ALIKE, 0.05 * does), (effect, apart, does)


@pytest.mark.slow
def test_a_ground_truth_is_what_finer_steps_tell_too(pendulum: Experiment) -> None:
    drawn = pendulum.draw(3, 1)
    ground_truth = replace(drawn, trials=drawn.trials[:1])
    stepped, trial = Stepped(ground_truth), trials_of(ground_truth)[0]
    finer = 2 * stepped.done(trial, 8 * FINER).shown - stepped.done(trial, 4 * FINER).shown
    assert np.abs(simulate_mjcf_truth(ground_truth)[1][0] - finer).max() < 2 * EXACT * ground_truth.noise[0]


def test_a_motion_that_no_step_tells_is_no_ground_truth(
    two_joints: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of an arm that swings for long from upright; with a bound on the steps that a test has time for."""
    monkeypatch.setattr("equimus_ctrl.proof.mjcf_simulation.FINEST", 4 * FINER)
    ground_truth = _ground_truth(two_joints.model, two_joints.recordings, (GravityTilt("base", 0.05),))
    with pytest.raises(
        SimulationDiverged, match=r"case 0 of seed 0: run_\d is so sensitive that its motion converges at no step"
    ):
        simulate_mjcf_truth(ground_truth)


@pytest.mark.slow
def test_a_case_repeats_and_its_neighbour_differs(pendulum: Experiment) -> None:
    first, again = (pendulum.draw(3, 1) for _ in range(2))
    assert first.robot.parameters() == again.robot.parameters()
    assert first.effects == again.effects and first.noise == again.noise
    assert first.robot.parameters() != pendulum.draw(3, 2).robot.parameters()
    (_, one), (_, two) = simulate_mjcf_truth(first), simulate_mjcf_truth(again)
    assert all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(noise(first), noise(again), strict=True))


def test_a_robot_that_no_fit_can_follow_is_drawn_again(
    pendulum: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Wild(Experiment):
        def simulate(self, ground_truth: GroundTruth) -> tuple[GroundTruth, list[Array]]:
            return ground_truth, [np.zeros_like(own) for own in noise(ground_truth)]

        def excess(
            self, ground_truth: GroundTruth, clean: Sequence[Array], effects: Sequence[Effect] = (), refit: bool = True
        ) -> Excess:
            if ground_truth.robot.parameters() == pendulum.draw(3, 1).robot.parameters():
                raise SimulationDiverged("too stiff")
            return Excess(1.0, (1.0,), {})

    monkeypatch.setattr(store, "stops", lambda model, scatter: [])  # they do not move
    request = Request.of_mjcf(tmp_path, 3, None, Wild(pendulum.model, pendulum.recordings))
    found, _, truth = request.ground_truth(1)
    assert found.robot.parameters() == pendulum.draw(3, 1, attempt=1).robot.parameters()
    assert truth["excess"] == 1.0 and truth["kind"] == found.kind


def test_what_is_concealed_is_what_a_diagnosis_would_believe(pendulum: Experiment) -> None:
    for case in range(40):
        ground_truth = pendulum.draw(1, case, "pair")
        for effect in ground_truth.effects:
            for key in effect.parameter_info():
                low, high = effect.bounds(key, ground_truth.robot)
                assert low <= getattr(effect, key) <= high, (case, effect, key)


def test_friction_of_all_joints_is_drawn_where_no_parameter_takes_it_up(two_joints: Experiment) -> None:
    def drawn(values: dict[str, float]) -> set[tuple[str, str]]:
        experiment = replace(two_joints, model=two_joints.model.with_parameters(values))
        return {(e.name, e.location) for e in experiment.draw(1, 0, "all_joints").effects}

    both = {("coulomb_friction", "shoulder"), ("coulomb_friction", "elbow")}
    assert drawn({}) == both | {("viscous_friction", "shoulder"), ("viscous_friction", "elbow")}
    assert drawn({"elbow.damping": 0.1}) == both | {("viscous_friction", "shoulder")}
    with pytest.raises(ConfigError, match=r"dry friction already, which is estimated, .* give a model without"):
        drawn({"shoulder.frictionloss": 0.1})


def test_all_kinds_are_drawn_and_each_is_what_it_says(two_joints: Experiment) -> None:
    kinds = set()
    for case in range(30):
        ground_truth = two_joints.draw(1, case)
        kinds.add(ground_truth.kind)
        names = {e.name for e in ground_truth.effects}
        assert len(names) == {"none": 0, "single": 1, "pair": 2, "outside": 0}[ground_truth.kind]
        assert (len(ground_truth.outside) > 0) == (ground_truth.kind == "outside")
        assert not names & set(OUTSIDE)
        shares = {n: ground_truth.robot.parameters()[n] / two_joints.model.parameters()[n] for n in ground_truth.drawn}
        assert shares and all(0.55 < share < 1.45 for share in shares.values())
    assert kinds == {"none", "single", "pair", "outside"}


@pytest.mark.slow
def test_nothing_left_out_leaves_nothing_and_friction_does(pendulum: Experiment) -> None:
    plain = pendulum.draw(5, 0, "none")
    _, clean = simulate_mjcf_truth(plain)
    assert mjcf_excess(plain, clean).total < 0.02
    rubbing = replace(plain, kind="single", effects=(REGISTRY["coulomb_friction"]("hinge", friction=0.1),))
    _, clean = simulate_mjcf_truth(rubbing)
    assert mjcf_excess(rubbing, clean).total > 10
    assert mjcf_excess(rubbing, clean, rubbing.effects).total < 0.02


@pytest.mark.slow
def test_what_is_recorded_is_noise_upon_the_motion(pendulum: Experiment) -> None:
    ground_truth = pendulum.draw(5, 1, "none")
    _, clean = simulate_mjcf_truth(ground_truth)
    seen = mjcf_recordings(ground_truth, clean, noise(ground_truth))
    error = np.concatenate([r.position - c for r, c in zip(seen, clean, strict=True)])
    assert error.std() == pytest.approx(ground_truth.noise[0], rel=0.1)
    assert [r.name for r in seen] == [r.name for r in pendulum.recordings]
    assert np.array_equal(seen[0].command, pendulum.recordings[0].command)


@pytest.mark.slow
def test_what_differs_between_trials_is_simulated_and_passed_on(pendulum: Experiment) -> None:
    noted = tuple(replace(r, notes={"set.arm.mass": "0.9"}) for r in pendulum.recordings)
    experiment = Experiment(pendulum.model, noted)
    ground_truth = experiment.draw(2, 0, "none")
    heavy = ground_truth.model.with_parameters({"arm.mass": 0.9})
    bare = [replace(t, settings={}) for t in trials_of(ground_truth)]
    light, right = (without_steps(m, bare) for m in (Model(ground_truth.robot), heavy))
    for own, wrong, other in zip(simulate_mjcf_truth(ground_truth)[1], light, right, strict=True):
        assert np.abs(own - other).max() < ALIKE < np.abs(own - wrong).max()
    assert (
        mjcf_recordings(ground_truth, simulate_mjcf_truth(ground_truth)[1], noise(ground_truth))[0].notes
        == noted[0].notes
    )


@pytest.mark.parametrize(("times", "far"), [((1.0, 1.0, 2.5, 1.0), 0), ((4.0, 1.0, 3.5, 1.0), 2)])
def test_robots_that_run_away_without_their_controller_are_told(
    times: tuple[float, ...], far: int, pendulum: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def recorded(folder: Path, model: Model) -> list[Recording]:
        scale = times[int(folder.name.rpartition("_")[2])]
        return [replace(r, position=scale * r.position) for r in pendulum.recordings]

    monkeypatch.setattr("equimus_ctrl.workflow.proofs.recorded", recorded)
    said = far_beyond(Request.of_mjcf(tmp_path, 1, None, pendulum), range(len(times)))
    assert len(said) == (far > 0)
    assert not far or said[0].startswith(f"{far} of 4 robots moved more than 3 times as far")


def tracked(
    model: Model, recordings: tuple[Recording, ...], effects: tuple[Effect, ...]
) -> tuple[GroundTruth, list[Array]]:
    """Of an arm a fifth heavier than the model, whose controllers know the model alone."""
    masses = {name: 1.2 * value for name, value in model.parameters().items() if name.endswith((".mass", ".inertia"))}
    heavier = replace(_ground_truth(model, recordings, effects), robot=model.with_parameters(masses).robot)
    return simulate_mjcf_truth(heavier, Experiment(model, recordings, 2.0).tracking)


@pytest.mark.parametrize(
    "effects", [(), (REGISTRY["transport_delay"]("motor2", delay=0.015),)], ids=["bare", "delayed"]
)
@pytest.mark.parametrize("linear", [False, True])
def test_controllers_keep_robots_near_the_recorded_motion(
    effects: tuple[Effect, ...], linear: bool, two_joints: Experiment
) -> None:
    model, (first, _) = two_joints.model, two_joints.recordings
    if linear:
        first = replace(first, notes={"interpolation": "linear"})
    truth, (shown,) = tracked(model, (first,), effects)
    _, (alone,) = simulate_mjcf_truth(replace(truth, trials=_ground_truth(model, (first,), ()).trials))
    off = [np.abs(found - first.position).max() for found in (shown, alone)]
    assert off[0] < 0.4 * off[1] and off[0] < 0.1
    assert np.ptp(truth.trials[0].command - first.command, axis=0).min() > 0.1
    # The commands are those that acted: given as they stand in the recording they do the same.
    stepped, (trial,), (controller,) = Stepped(truth), trials_of(truth), Experiment(model, (first,), 2.0).tracking
    own = stepped.done(trial, FINER, controller)
    again = stepped.done(replace(trial, commands=own.command), FINER)
    np.testing.assert_allclose(again.shown, own.shown, rtol=0, atol=1e-7)


def test_what_tracks_has_no_servo_and_samples_close_enough(two_joints: Experiment) -> None:
    with pytest.raises(
        ConfigError, match=r"track is 9 Hz, expected more than 0 and at most 8\.33 Hz, a twelfth of the"
    ):
        replace(two_joints, track=9.0)
    arm = load_model(Path(__file__).resolve().parents[1] / "benchmarks" / "real_machines" / "xl330.xml")
    time = np.arange(0.0, 2.0, 0.01)
    goal = np.sin(time)[:, None]
    at = Recording("r", time, goal, goal, arm.robot.actuator_names, arm.robot.joint_names)
    with pytest.raises(ConfigError, match="is a servo, which tracks by itself; leave --track out"):
        Experiment(arm, (at, at), 2.0)


@pytest.mark.slow
def test_a_proof_of_a_pendulum_from_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(EXAMPLES / "pendulum" / f"run_{k}.csv") for k in (1, 2)]
    command = ["prove", *files, "--model", str(EXAMPLES / "pendulum.xml"), "--cases", "2", "--kind", "none", "--seed",
               "8", "--no-figures", "--json", "--output", str(tmp_path / "proof")]  # fmt: skip
    assert main(command) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert found["robot"] == "pendulum"
    assert found["false_alarms"]["all"] == {**found["false_alarms"]["all"], "count": 0, "of": 2}
    assert "sealed" in err
    assert main(command) == 0
    assert "2 of 2 cases were diagnosed before" in capsys.readouterr().err
    assert main([*command[:2], *command[3:]]) == 2
    assert "holds a proof with trials 2, not 1; choose another folder" in capsys.readouterr().err
    xml = (EXAMPLES / "pendulum.xml").read_text()
    (tmp_path / "pendulum.xml").write_text(xml.replace('mass="0.6"', 'mass="0.9"'))
    command[command.index(str(EXAMPLES / "pendulum.xml"))] = str(tmp_path / "pendulum.xml")
    assert main(command) == 2
    assert "holds a proof with another model; choose another folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([str(EXAMPLES / "pendulum")], "recordings are for --model"),
        (["--model", str(EXAMPLES / "pendulum.xml")], "give their folder or files"),
        ([str(EXAMPLES / "pendulum"), "--model", str(EXAMPLES / "heavy_leg.toml")], "is no MJCF robot"),
        ([str(EXAMPLES / "pendulum"), "--model", str(EXAMPLES / "pendulum.xml"), "--trials", "3"], "are for legs"),
        ([str(EXAMPLES / "pendulum"), "--model", str(EXAMPLES / "pendulum.xml"), "--baselines"], "are for legs"),
    ],
)  # fmt: skip
def test_what_does_not_go_together_is_told(
    options: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["prove", *options, "--output", str(tmp_path / "p")]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "p").exists()


def test_a_leg_is_no_mjcf_robot(pendulum: Experiment) -> None:
    with pytest.raises(ConfigError, match="no MJCF robot"):
        Experiment(nominal_model(), pendulum.recordings)
