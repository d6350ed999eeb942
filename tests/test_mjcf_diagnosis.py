"""Identification and diagnosis of MJCF robots, on simulated recordings that conceal something, and on real ones."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pendulum_runs import CARRIAGE, MOTOR, NOISE, PENDULUM, SERVO, recorded

from equimus_ctrl import workflow
from equimus_ctrl.diagnosis import intervals
from equimus_ctrl.diagnosis.alternatives import in_place, indistinguishable
from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.confirmation import _another
from equimus_ctrl.diagnosis.confounding import generalises, restates
from equimus_ctrl.diagnosis.coordinates import read
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.force_basis import ForceFamily
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, default_free_parameters
from equimus_ctrl.diagnosis.intervals import longest_interval
from equimus_ctrl.diagnosis.policy import SearchPolicy, SearchSettings
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.screening import screen
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchHistory, SearchState
from equimus_ctrl.effects import (
    ConstantForce,
    CoulombFriction,
    Creep,
    DrivePlay,
    Effect,
    GravityTilt,
    NarrowingArea,
    NonlinearStiffness,
    ParallelSpring,
    PayloadMass,
    QuadraticDamping,
    SensorDelay,
    TorqueSaturation,
    TransportDelay,
    ViscousFriction,
)
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.identification.fit import FitSettings, fit
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings import find_recordings
from equimus_ctrl.report.diagnosis_page import page
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording

ROOT = Path(__file__).resolve().parents[1]


def diagnosed(xml: str, concealed: Sequence[Effect], **given: object) -> Diagnosis:
    robot = MjcfRobot("robot", xml)
    trials = recorded(Model(robot, concealed), **given)  # type: ignore[arg-type]
    return workflow.diagnose(trials, Model(robot), most=1)


def named(found: Diagnosis) -> list[tuple[str, tuple[str, ...]]]:
    return [(f.named.effect, f.named.locations) for f in found.findings]


def value(found: Diagnosis, k: int = 0) -> float:
    return next(iter(found.findings[k].parameters.values())).value


@pytest.mark.slow
def test_friction_of_a_hinge_is_found_with_its_size_and_told_whole(tmp_path: Path) -> None:
    found = diagnosed(PENDULUM.format(drive=MOTOR), [CoulombFriction("hinge", 0.08)])
    assert found.verdict == "explained" and named(found) == [("coulomb_friction", ("hinge",))]
    estimate = found.findings[0].parameters["friction"]
    assert estimate.value == pytest.approx(0.08, rel=0.02) and estimate.low <= 0.08 <= estimate.high
    assert estimate.unit == "N·m" and found.rmse("corrected", "validation")[0] < 1.2 * NOISE
    text = page(found, "robot")
    assert "angle of hinge" not in text.split("<img")[0]
    text = re.sub(r'src="data:[^"]*"', "", text)
    assert "Dry friction at the hinge of" in text and "kPa" not in text


@pytest.mark.long
@pytest.mark.slow
def test_two_kinds_of_friction_of_one_joint_are_told_by_their_names() -> None:
    """A push over the speed could stand for both, and dry friction with more at rest for the dry one."""
    robot = MjcfRobot("robot", PENDULUM.format(drive=MOTOR))
    real = Model(robot, [CoulombFriction("hinge", 0.06), ViscousFriction("hinge", 0.04)])
    found = workflow.diagnose(recorded(real, seed=5), Model(robot), most=2)
    assert sorted(named(found)) == [("coulomb_friction", ("hinge",)), ("viscous_friction", ("hinge",))]
    sizes = {f.named.effect: value(found, k) for k, f in enumerate(found.findings)}
    assert sizes["coulomb_friction"] == pytest.approx(0.06, rel=0.05)
    assert sizes["viscous_friction"] == pytest.approx(0.04, rel=0.05)


@pytest.mark.slow
def test_nothing_left_out_is_consistent_and_says_what_would_have_shown() -> None:
    found = diagnosed(PENDULUM.format(drive=MOTOR), [], seed=3)
    assert found.verdict == "consistent" and not found.findings
    smallest = {d.named.effect: d for d in found.detectable if len(d.named.locations) == 1}
    assert 0 < smallest["coulomb_friction"].size < 0.02 and smallest["coulomb_friction"].unit == "N·m"


@pytest.mark.slow
def test_a_closed_loop_tells_its_friction_too() -> None:
    found = diagnosed(PENDULUM.format(drive=SERVO), [CoulombFriction("hinge", 0.15)])
    assert named(found) == [("coulomb_friction", ("hinge",))] and value(found) == pytest.approx(0.15, rel=0.03)


@pytest.mark.long
@pytest.mark.slow
def test_what_slides_is_told_in_metres_and_newtons() -> None:
    found = diagnosed(CARRIAGE, [ViscousFriction("rail", 6.0)], size=8.0, noise=2e-4)
    assert named(found) == [("viscous_friction", ("rail",))] and value(found) == pytest.approx(6.0, rel=0.02)
    assert found.findings[0].parameters["damping"].unit == "N·s/m"
    text = re.sub(r'src="data:[^"]*"', "", page(found, "carriage"))
    assert "RMSE in mm" in text and "mrad" not in text and "°" not in text


@pytest.mark.slow
def test_a_payload_shows_where_masses_are_known() -> None:
    robot = MjcfRobot("robot", PENDULUM.format(drive=MOTOR))
    trials = recorded(Model(robot, [PayloadMass("tip", 0.12)]))
    found = workflow.diagnose(trials, Model(robot), free=["hinge.armature"], most=1)
    group = {(f.named.effect, f.named.locations) for f in found.findings}
    group |= {(o.effect, o.locations) for f in found.findings for o in f.equivalent}
    assert ("payload_mass", ("tip",)) in group


@pytest.mark.slow
def test_a_late_drive_is_named() -> None:
    found = diagnosed(PENDULUM.format(drive=MOTOR), [TransportDelay("drive", 0.03)])
    group = set(named(found)) | {(o.effect, o.locations) for o in found.findings[0].equivalent}
    assert ("transport_delay", ("drive",)) in group and value(found) == pytest.approx(0.03, rel=0.05)


@pytest.mark.slow
def test_play_in_a_drive_is_named() -> None:
    found = diagnosed(PENDULUM.format(drive=SERVO), [DrivePlay("hinge", 0.05)], size=0.8)
    group = set(named(found)) | {(o.effect, o.locations) for f in found.findings for o in f.equivalent}
    assert ("drive_play", ("hinge",)) in group


@pytest.mark.slow
def test_what_no_effect_does_is_left_unexplained() -> None:
    found = diagnosed(PENDULUM.format(drive=MOTOR), [], push=0.1)
    assert found.verdict in ("unexplained", "partly_explained") and found.unexplained


def stepped(dt: float) -> MjcfRobot:
    """The pendulum with a physics step [s]."""
    return MjcfRobot("robot", PENDULUM.format(drive=MOTOR).replace('timestep="0.002"', f'timestep="{dt}"'))


@pytest.mark.long
@pytest.mark.slow
def test_the_error_of_a_long_step_is_taken_for_no_physics() -> None:
    fine, coarse = stepped(0.00002), stepped(0.01)
    trials = recorded(Model(fine), dt=None)
    exact = workflow.diagnose(trials, Model(coarse), most=1)
    assert exact.engine.name == "reduced" and exact.verdict == "consistent"
    assert not any("physics step" in note for note in exact.notes)
    found = workflow.diagnose(trials, Model(coarse), most=1, engine="mujoco")
    assert found.engine.name == "mujoco" and found.verdict == "consistent" and not found.findings
    (told,) = [note for note in found.notes if "physics step of the XML, 10 ms, is too long" in note]
    assert "without that error, from simulations with 2.5 ms too" in told
    assert found.rmse("corrected", "validation")[0] < 1.2 * NOISE


@pytest.mark.long
@pytest.mark.slow
def test_what_a_finer_step_fits_far_worse_stays_named() -> None:
    """Without the step, which is half a step early, no delay is needed, and none would be early enough."""
    coarse = stepped(0.01)
    trials = recorded(Model(coarse, [SensorDelay("hinge", 0.003)]), dt=None)
    found = workflow.diagnose(trials, Model(coarse), most=1, engine="mujoco")
    group = set(named(found)) | {(o.effect, o.locations) for f in found.findings for o in f.equivalent}
    assert ("sensor_delay", ("hinge",)) in group
    assert found.rmse("corrected", "validation")[0] < 1.2 * NOISE


@pytest.mark.long
@pytest.mark.slow
def test_what_fits_as_well_is_told_after_a_finer_step_too() -> None:
    """A tilt and a sensor's offset do the same to a pendulum, whatever step that was found with; so may others."""
    fine, coarse = stepped(0.00002), stepped(0.01)
    real = Model(fine, [GravityTilt("base", 0.05)])
    found = workflow.diagnose(recorded(real, dt=None), Model(coarse), most=1, engine="mujoco")
    assert any("physics step of the XML, 10 ms, is too long" in note for note in found.notes)
    (tilt,) = found.findings
    assert {tilt.named.effect, *(e.effect for e in tilt.equivalent)} >= {"gravity_tilt", "sensor_offset"}
    assert sum(r.fitted is not None for r in found.ranking) > 2  # what was fitted with the XML's step


def test_what_is_far_weaker_than_any_guess_is_looked_for_at_its_own_size() -> None:
    """Along a trial a weak drag adds up; a hundred times as much would stop the pendulum and say nothing of it."""
    robot = MjcfRobot("robot", PENDULUM.format(drive=MOTOR))
    model, drag = Model(robot), 0.0003
    trials = recorded(Model(robot, [QuadraticDamping("hinge", drag)]), seed=4)
    parts = split(model, trials)
    own = Simulator(engine_for(model), 1)
    policy = SearchPolicy(coarse_derivatives=True, rescaled_guesses=True)
    data = Data(
        default_free_parameters(model), parts.train, own, replace(own, engine=own.engine.coarser()), policy=policy
    )
    base, pool = data.base(), [c for c in candidates(model, parts.train) if c.label == "quadratic_damping:hinge"]
    least = min(guess["drag"] for guess in pool[0].guesses)
    (found,), (blunt,) = screen(data, base, pool), screen(replace(data, policy=SearchPolicy()), base, pool)
    value = found.hypothesis[-1].values["drag"]
    assert drag < 0.3 * least and drag / 3 < value < 3 * drag
    assert max(found.gains) > max(blunt.gains)


@pytest.mark.slow
def test_a_limit_that_the_trial_held_out_never_reaches_is_named() -> None:
    robot = MjcfRobot("robot", PENDULUM.format(drive=MOTOR))
    real = Model(robot, [TorqueSaturation("drive", 0.6)])
    loud, quiet = recorded(real, count=2, seed=1), recorded(real, count=1, seed=2, size=0.35)
    trials = [*loud, replace(quiet[0], name="quiet")]
    assert np.abs(quiet[0].command).max() < 0.6 < np.abs(loud[0].command).max()
    found = workflow.diagnose(trials, Model(robot), validation=["quiet"], most=1)
    assert named(found) == [("torque_saturation", ("drive",))] and value(found) == pytest.approx(0.6, rel=0.02)


def test_a_push_over_what_a_law_depends_on_restates_it() -> None:
    def family(location: str, joint: str, told: str) -> ForceFamily:
        return ForceFamily(location, (joint,), told, "", (), {})

    def part(label: str, law: type[Effect]) -> tuple[Part, ...]:
        return (Part(Candidate(law, (label,), ({},)), {}),)

    area, cubic, creep = part("maa", NarrowingArea), part("maa", NonlinearStiffness), part("maa", Creep)
    by_length, shared = family("maa", "hip", "len.maa"), family("maa", "hip", "len.maa·cmd.maa")
    assert restates(shared, area, False) == "same" and not restates(by_length, area, False)
    assert restates(by_length, cubic, False) == "same" and not restates(shared, cubic, False)
    assert restates(family("maa", "hip", "past.maa"), creep, False) == "same"
    assert not restates(family("baa", "knee", "len.baa·cmd.baa"), area, False)
    limit = part("drive", TorqueSaturation)
    assert restates(family("drive", "hinge", "cmd.drive"), limit, True) == "same"
    assert not restates(family("hinge", "hinge", "pos.hinge"), limit, True)
    dry = part("hinge", CoulombFriction)
    assert restates(family("hinge", "hinge", "vel.hinge"), dry, True) == "same"
    assert restates(family("hinge", "hinge", "pos.hinge·sign(vel.hinge)"), dry, True) == "more"
    assert not restates(family("hinge", "hinge", "time"), dry, True)
    assert restates(family("hinge", "hinge", "time"), part("hinge", ConstantForce), True) == "more"
    assert not restates(family("hinge", "hinge", "time"), part("hinge", TransportDelay), True)
    surface = family("hinge", "hinge", "pos.hinge·vel.hinge")
    assert restates(surface, dry, True) == "more"
    assert restates(surface, (*dry, *part("hinge", ParallelSpring)), True) == "same"


def test_a_force_that_is_a_laws_own_coordinate_times_a_function_of_another_generalises_it() -> None:
    def family(factor: str, *over: str, joint: str = "hinge") -> ForceFamily:
        by = read(factor)[0] if factor else None
        return ForceFamily(joint, (joint,), read("·".join([*over, *([factor] if factor else [])])), by, (), {})

    damping, spring = (Part(Candidate(law, ("hinge",), ({},)), {}) for law in (ViscousFriction, ParallelSpring))
    of_the_angle = family("vel.hinge", "pos.hinge")
    assert generalises(of_the_angle, damping) and generalises(family("sign(vel.hinge)", "pos.hinge"), damping)
    assert not generalises(of_the_angle, spring)  # the spring is not what depends on the speed
    assert not generalises(family("", "vel.hinge"), damping)  # another curve over the speed
    assert not generalises(family("vel.other", "pos.other", joint="other"), damping)


def test_a_fit_goes_on_with_the_derivatives_of_an_earlier_ones_end() -> None:
    robot = MjcfRobot("robot", PENDULUM.format(drive=MOTOR))
    nominal = Model(robot)
    free, simulator = default_free_parameters(nominal), Simulator(engine_for(nominal, "mujoco"))
    some = split(nominal, recorded(Model(robot, [ViscousFriction("hinge", 0.05)]), seed=7)).train
    noise = white_noise([np.full((100, 1), NOISE)])
    first = fit(free, some, simulator=simulator, noise=noise, settings=FitSettings(1e-3, 2))
    end = [(first.theta, first.starts)]
    one = FitSettings(1e-5, 1)
    alone = fit(free, some, simulator=simulator, noise=noise, settings=one, begin=end)
    going_on = fit(free, some, simulator=simulator, noise=noise, settings=one, begin=end, earlier=first)
    derivative = len(free.free) + max(s.free_start for s in some)
    assert going_on.evaluations == alone.evaluations - derivative
    np.testing.assert_array_equal(going_on.theta, alone.theta)
    for one_way, other in zip(going_on.jacobians, alone.jacobians, strict=True):
        np.testing.assert_array_equal(one_way, other)
    # Elsewhere, or by another engine, they say nothing.
    begun = [(free.start, [s.start for s in some])]
    elsewhere = [
        fit(free, some, simulator=simulator, noise=noise, settings=one, begin=begun, earlier=e) for e in (None, first)
    ]
    assert elsewhere[0].evaluations == elsewhere[1].evaluations
    finer = Simulator(engine_for(nominal, "mujoco", dt=5e-4))
    others = [fit(free, some, simulator=finer, noise=noise, settings=one, begin=end, earlier=e) for e in (None, first)]
    assert others[0].evaluations == others[1].evaluations and not np.array_equal(others[0].theta, alone.theta)


class Searching:
    """A search over a pendulum's recordings, and hypotheses fitted by hand."""

    def __init__(self, concealed: Sequence[Effect]) -> None:
        robot = MjcfRobot("robot", PENDULUM.format(drive=MOTOR))
        nominal = Model(robot)
        self.split = split(nominal, recorded(Model(robot, concealed), seed=7))
        data = Data(default_free_parameters(nominal), self.split.train, Simulator(engine_for(nominal)))
        self.pool = candidates(nominal, self.split.train)
        self.search = Search(data, self.pool, SearchSettings(many_minima=True))
        self.base = data.base()
        self.tried = SearchHistory()

    def fitted(self, *labels: str) -> Fitted:
        """A hypothesis of effects, each at its weakest guess, fitted and remembered."""
        chosen = [next(c for c in self.pool if c.label == label) for label in labels]
        found, self.tried = self.search.refit(self.tried, self.base, tuple(Part(c, dict(c.guesses[0])) for c in chosen))
        return found

    def end(self, best: Fitted) -> SearchState:
        end = self.search.moved(SearchState(self.base, self.base, tried=self.tried), best)
        self.tried = end.tried
        return end


@pytest.mark.slow
def test_what_fitted_as_well_beside_other_parts_is_looked_at_beside_those_of_the_end() -> None:
    own = Searching([GravityTilt("base", 0.06), CoulombFriction("hinge", 0.05)])
    for label in ("gravity_tilt:base", "sensor_offset:hinge", "viscous_friction:hinge"):
        own.fitted(label)
    best = own.fitted("coulomb_friction:hinge", "sensor_offset:hinge")
    found = own.end(best)
    assert not found.alternatives[1]
    alternatives, _ = in_place(own.search, found, 1, lambda t: 30.0)
    assert [r.label for r in alternatives] == ["coulomb_friction:hinge gravity_tilt:base"]
    assert indistinguishable(own.search, alternatives[0], own.search.score(best))


def test_another_hypothesis_takes_the_place_of_one_that_trials_left_out_refuse() -> None:
    own = Searching([CoulombFriction("hinge", 0.05), ViscousFriction("hinge", 0.03)])
    poor = own.end(own.fitted("coulomb_friction:hinge", "sensor_scale:hinge"))
    kept, confirms = _another(own.search, poor, 1, own.split, set())
    assert not confirms and kept.best is poor.best
    true = own.fitted("coulomb_friction:hinge", "viscous_friction:hinge")
    better, confirms = _another(own.search, replace(poor, tried=own.tried), 1, own.split, set())
    assert confirms and better.best.label == true.label
    assert all(own.search.accepts(without, better.best) for without in better.without)


def test_short_windows_go_with_how_quick_a_motion_is() -> None:
    robot = MjcfRobot("robot", PENDULUM.format(drive=MOTOR))
    model = Model(robot)
    parts = split(model, recorded(model))
    lengths = {round(float(s.trial.sample_times[-1] - s.trial.start), 1) for s in parts.short_segments}
    assert len(parts.train) == 2 and parts.short_segments and lengths <= {0.5, 1.0, 2.0}
    assert sum(s.measured.size for s in parts.short_segments) == sum(s.measured.size for s in parts.train)
    assert not split(model, recorded(model), shoot=0.5).short_segments


def test_identification_gives_numbers_with_intervals() -> None:
    xml = PENDULUM.format(drive=MOTOR).replace(
        'armature="0.004"', 'armature="0.004" damping="0.05" frictionloss="0.05"'
    )
    robot = MjcfRobot("robot", xml)
    truth = {"arm.mass": 0.66, "hinge.damping": 0.03, "hinge.frictionloss": 0.08}
    trials = recorded(Model(robot.with_parameters(truth)), count=4)
    found = workflow.identify_recordings(trials, Model(robot), free=list(truth), folds=0)
    for name, at, width in zip(
        found.fit.parameters.names, found.fit.theta, found.fit.uncertainty.half_width, strict=True
    ):
        assert abs(at - truth[name]) < 2 * width and width < 0.05 * truth[name]


@pytest.mark.slow
def test_intervals_hold_although_the_physics_step_is_long() -> None:
    """What noise alone would allow does not: a step is half a step early, and the robot has none."""
    real, model = (Model(stepped(dt), [SensorDelay("hinge", late)]) for dt, late in ((0.00002, 0.02), (0.004, 0.015)))
    fit = workflow.identify_recordings(
        recorded(real, count=4, dt=None), model, free=["arm.mass", "hinge.sensor_delay.delay"], folds=0, engine="mujoco"
    ).fit
    ahead = fit.theta - [real.parameters()[name] for name in fit.parameters.names]
    off = np.abs(ahead)
    known, delay = fit.uncertainty, fit.parameters.names.index("hinge.sensor_delay.delay")
    assert (off <= known.half_width).all() and off[delay] > 4 * known.standard_error[delay]
    assert ahead[delay] == pytest.approx(0.002, rel=0.1) and known.half_width[delay] < 1.5 * off[delay]


@pytest.mark.slow
def test_an_unstable_robot_is_fitted_in_windows() -> None:
    """It stands on its head: what is concealed soon leads far astray, and its own model does not."""
    robot = MjcfRobot("robot", PENDULUM.format(drive=MOTOR).replace("0 0 -0.4", "0 0 0.4"))
    real = Model(robot, [CoulombFriction("hinge", 0.2)])
    trials = recorded(real, seconds=8.0)
    length = longest_interval(Model(robot), trials).length
    assert length is not None and length < 8.0
    assert longest_interval(real, trials).length is None


@pytest.mark.slow
def test_numbers_of_a_real_pendulum_are_near_the_published_ones() -> None:
    folder = find_recordings()
    path = None if folder is None else folder / "simple_pendulum"
    if path is None or not path.is_dir():
        pytest.skip("the recordings of the simple pendulum are not here (EQUIMUS_RECORDINGS)")
    trials = []
    for name, low, high in (("pd__1nm_torque_limited_swingup_failure", 11.7, 17.2), ("sac", 0, 4.2), ("ddp", 0, 99)):
        table = np.genfromtxt(path / f"{name}__data_measured.csv", delimiter=",", names=True)
        table = table[(table["time"] >= low) & (table["time"] <= high)]
        kept = np.concatenate([[True], np.diff(table["time"]) > 0])
        time, torque, angle = (table[key][kept] for key in ("time", "torque", "position"))
        trials.append(Recording(name, time, torque[:, None], angle[:, None], ("motor",), ("hinge",)))
    model = workflow.load_model(ROOT / "benchmarks" / "real_machines" / "simple_pendulum.xml")
    free = ["arm.mass", "arm.inertia", "hinge.damping", "hinge.frictionloss"]
    found = workflow.identify_recordings(trials, model, free=free, shoot=2.0, folds=0).fit
    friction = dict(zip(found.parameters.names, found.theta, strict=True))["hinge.frictionloss"]
    assert friction == pytest.approx(0.184, abs=0.03)  # Coulomb friction as its owners published it
    assert found.rmse[0] < 0.05 * found.rmse_before[0]


def test_intervals_are_chosen_with_the_engine_that_was_asked_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Chosen(Exception):
        pass

    def choosing(model: Model, trials: object, window: object, simulator: Simulator, whole: bool = True) -> float:
        raise Chosen(simulator.engine.name, simulator.threads)

    monkeypatch.setattr(intervals, "longest_interval", choosing)
    folder = Path(__file__).parent.parent / "docs" / "examples" / "pendulum"
    model = workflow.load_model(folder.with_suffix(".xml"))
    with pytest.raises(Chosen) as said:
        workflow.diagnose(folder, model, engine="mujoco", threads=1)
    assert said.value.args == ("mujoco", 1)
