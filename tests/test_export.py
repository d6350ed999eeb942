"""Models written as MJCF and simulated by MuJoCo alone: they move as the package's own simulation says, or are refused."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from effect_cases import CASES
from mjcf_models import ARM, BARE, HINGES, RIG, pendulum, refusal, swinging
from plain_mujoco import begins, played

import equimus_ctrl as eq
from equimus_ctrl.cli.main import main
from equimus_ctrl.effects import REGISTRY, DeadZone, Effect, FirstOrderLag, RateLimit, Saturation, catalogue, make
from equimus_ctrl.effects.base import parameter
from equimus_ctrl.effects.bodies import BodyEffect
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.effects.native import Draft, add_constant_force
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.leg import ideal_leg, nominal_leg
from equimus_ctrl.robots.elastic.morphology import Joint, JointStop, Morphology, Phase
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array

LEG = nominal_leg()
HERE = {kind: names[-1] for kind, names in LEG.places().items()} | {"link": "thigh"}
STEP, FINE = 2e-3, 5e-4
"""Physics steps of files, the usual one of a leg and a quarter of it [s]."""
EXACT = 1e-4
"""Of the reduced engine that they are compared with [s]."""


def written(model: Model, folder: Path, **options: Any) -> Path:
    """The file of a model."""
    path = folder / "own.xml"
    eq.export_model(path, model, force=True, **options)
    return path


def stepping(start: Array, phase: Phase = "swing") -> Trial:
    """Steps of both pressures, at the same times [Pa]; a leg that stands soon falls onto its stop."""
    rows = [(0, 0), (12, 4), (20, 9), (6, 2), (15, 12), (30, 20), (2, 3), (10, 5)]
    commands = 1e3 * np.array(rows if phase == "swing" else rows[:2], dtype=float)
    times = 0.3 * np.arange(len(commands))
    until = 2.4 if phase == "swing" else 0.14
    return Trial("steps", times, commands, commands[0], 0.0, start, np.arange(0.0, until + 1e-9, 0.02))


def reduced(model: Model, trial: Trial) -> Array:
    """(m, nj) what the reduced engine says that sensors show [rad]."""
    (found,) = simulate([model], [trial], dt=EXACT, threads=1)
    return found.position[0]


def legs_file(model: Model, path: Path, trial: Trial) -> Array:
    return played(path, trial, model.robot.joint_names, model.robot.actuator_names)


# --- legs without effects -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def leg_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(Model(LEG), tmp_path_factory.mktemp("leg"))


@pytest.mark.parametrize("kpa", [(0, 0), (50, 0), (0, 50), (50, 50), (10, 20), (0, 30)])
def test_a_leg_comes_to_rest_where_it_does(kpa: tuple[float, float], leg_file: Path) -> None:
    """Within 1e-5 rad, its knee at the stop too: without stops it ended up to 39° away."""
    model, pressure = mujoco.MjModel.from_xml_path(str(leg_file)), 1e3 * np.array(kpa, dtype=float)
    data = mujoco.MjData(model)
    data.ctrl[:] = pressure
    for _ in range(round(10 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    found = [data.qpos[model.joint(name).qposadr[0]] for name in LEG.joint_names]
    np.testing.assert_allclose(found, rest_pose(Model(LEG), pressure), rtol=0, atol=1e-5)
    if kpa[1] >= 30:
        assert found[1] < -0.035  # pressed into its stop


@pytest.mark.parametrize("phase", ["swing", "stance"])
@pytest.mark.parametrize("robot", [LEG, ideal_leg()], ids=lambda robot: robot.name)
def test_a_leg_moves_as_the_exact_equations_say(robot: Morphology, phase: Phase, tmp_path: Path) -> None:
    """Where no stop is hit: within 1e-5 rad, at steps of 2 ms."""
    model = Model(robot, phase=phase)
    path = written(model, tmp_path)
    trial = stepping(begins(path, robot.joint_names), phase)
    exact = reduced(model, trial)
    assert np.ptp(exact, axis=0).max() > 0.1
    np.testing.assert_allclose(legs_file(model, path, trial), exact, rtol=0, atol=1e-5)


HITTING = 1e3 * np.array([(0, 0), (45, 0), (0, 50), (0, 0), (50, 50), (0, 0)], dtype=float)


def hitting(start: Array) -> Trial:
    times = 0.2 * np.arange(len(HITTING))
    return Trial("stops", times, HITTING, HITTING[0], 0.0, start, np.arange(0.0, 1.6 + 1e-9, 0.02))


STOPS = {
    "as they are": LEG,
    "that differ": replace(
        LEG, joints=(LEG.joints[0], replace(LEG.joints[1], lower=JointStop(-0.035), upper=JointStop(0.9, 20.0, 0.3)))
    ),
    "one alone": replace(LEG, joints=(LEG.joints[0], replace(LEG.joints[1], upper=None))),
}


@pytest.mark.parametrize("name", STOPS)
def test_a_leg_hits_its_stops(name: str, tmp_path: Path) -> None:
    """Within 1e-3 rad while and after a stop is hit, the discretisation error of steps of 2 ms."""
    model = Model(STOPS[name])
    path = written(model, tmp_path)
    trial = hitting(begins(path, LEG.joint_names))
    exact = reduced(model, trial)
    assert exact[:, 1].min() < -0.035
    if name == "that differ":
        assert exact[:, 1].max() > 0.9
    np.testing.assert_allclose(legs_file(model, path, trial), exact, rtol=0, atol=1e-3)


def test_a_quick_robot_has_shorter_steps(tmp_path: Path) -> None:
    """A finger's stop is too stiff for 2 ms, with which it would never come to rest there."""
    model = eq.load_model(Path(__file__).parents[1] / "docs" / "examples" / "finger.toml")
    path = written(model, tmp_path)
    assert mujoco.MjModel.from_xml_path(str(path)).opt.timestep == 5e-4
    start, (low, high) = begins(path, model.robot.joint_names), model.robot.command_limits
    times = 0.3 * np.arange(5)
    commands = low + np.outer([0, 0.3, 1, 0.1, 0.7], high - low)
    trial = Trial("finger", times, commands, low, 0.0, start, np.arange(0.0, 1.8, 0.02))
    exact = reduced(model, trial)
    assert exact.max() > model.robot.joint_range[1][0]
    own = legs_file(model, path, trial)
    np.testing.assert_allclose(own, exact, rtol=0, atol=1e-3)
    np.testing.assert_allclose(own[-5:], exact[-5:], rtol=0, atol=1e-5)
    coarse = written(model, tmp_path, timestep=2e-3)
    assert np.abs(legs_file(model, coarse, trial) - exact)[-5:].max() > 3e-4


def test_a_leg_without_stops_is_written_without(tmp_path: Path) -> None:
    joints: tuple[Joint, ...] = tuple(replace(joint, lower=None, upper=None) for joint in LEG.joints)
    model = Model(replace(LEG, joints=joints))
    path = written(model, tmp_path)
    assert not mujoco.MjModel.from_xml_path(str(path)).jnt_limited.any()
    trial = hitting(begins(path, LEG.joint_names))
    exact = reduced(model, trial)
    assert exact[:, 1].min() < -0.1
    np.testing.assert_allclose(legs_file(model, path, trial), exact, rtol=0, atol=1e-5)


def test_a_leg_begins_closed_and_in_its_poses(leg_file: Path) -> None:
    """After a reset and at every keyframe both ends of each element meet, to the six digits that are written."""
    model = mujoco.MjModel.from_xml_path(str(leg_file))
    data = mujoco.MjData(model)
    assert [model.key(k).name for k in range(model.nkey)] == ["rest", *LEG.poses]
    for key in (-1, *range(model.nkey)):
        mujoco.mj_resetDataKeyframe(model, data, key) if key >= 0 else mujoco.mj_resetData(model, data)
        mujoco.mj_forward(model, data)
        for name in LEG.actuator_names:
            apart = data.site(f"{name}/end").xpos - data.site(f"{name}/insertion").xpos
            assert np.abs(apart).max() < 5e-6
    mujoco.mj_resetDataKeyframe(model, data, 1)
    hip, knee = (data.qpos[model.joint(name).qposadr[0]] for name in LEG.joint_names)
    assert (hip, knee) == (pytest.approx(LEG.poses["stretched"][0], abs=1e-5), LEG.poses["stretched"][1])


def test_elements_of_a_file_can_be_closed_again(leg_file: Path) -> None:
    """``close_elements`` knows joints that do not begin at 0."""
    model = mujoco.MjModel.from_xml_path(str(leg_file))
    data = mujoco.MjData(model)
    data.qpos[model.joint("hip").qposadr[0]] += 0.1
    data.qpos[model.joint("knee").qposadr[0]] -= 0.2
    eq.close_elements(model, data)
    for name in LEG.actuator_names:
        np.testing.assert_allclose(data.site(f"{name}/end").xpos, data.site(f"{name}/insertion").xpos, atol=1e-12)


# --- every effect of the catalogue --------------------------------------------------------------------------------

AT = {"joint": "shoulder", "actuator": "lift", "foot": "tip", "link": "arm", "base": "base"}
OWN = [name for name, cls in REGISTRY.items() if cls.__module__.startswith("equimus_ctrl.")]
CONTRACT = [
    (robots, name, kind)
    for robots in ("elastic", "mjcf")
    for name, cls in catalogue(robots).items()
    for kind in (cls.sits_at if robots == "elastic" else cls.sits_at[:1])
    if name in OWN
]
MOST_OFF = 2e-3
"""How far a file is from the package's simulation at most: MuJoCo takes commands, filters and friction up to a step
later or earlier than the package, which knows when within a step things happen [rad or m]."""
DIGITS = 2e-3
"""What the six digits of a file change, as a share of what the effect does."""


def one_effect(robots: str, name: str, kind: str) -> Model:
    """A robot that has an effect at a place of a kind, with numbers that nobody could overlook."""
    if robots == "elastic":
        return Model(LEG, (make(name, HERE[kind], CASES[name].strong[kind]),))
    numbers = CASES[name].mjcf
    assert numbers is not None
    robot = next(r for r in (RIG, BARE, HINGES) if AT[kind] in REGISTRY[name].places_on(r)[kind])
    return Model(robot, (make(name, AT[kind], numbers),))


def both(model: Model, folder: Path, step: float) -> tuple[Array, Array, Array]:
    """(m, nj) of a file, of the package, and of the package without effects, from where the file begins."""
    path, robot = written(model, folder, timestep=step), model.robot
    start, bare = begins(path, robot.joint_names), Model(robot)
    if robot.traits.catalogue == "elastic":
        trial = stepping(start)
        return legs_file(model, path, trial), reduced(model, trial), reduced(bare, trial)
    given = swinging(until=3.0)
    trial = replace(given, before=np.zeros(2), position=start, velocity=None, sample_times=np.arange(0, 3.001, 0.02))
    own = (simulate_mjcf([m], [trial], threads=1, dt=step)[0].position[0] for m in (model, bare))
    return played(path, trial, robot.joint_names, robot.actuator_names), *own


@pytest.mark.parametrize(("robots", "name", "kind"), CONTRACT)
def test_every_effect_is_written_and_acts_or_is_refused(robots: str, name: str, kind: str, tmp_path: Path) -> None:
    """Off by no more than a step's worth, at a quarter of the step by less than half of that."""
    model, cls = one_effect(robots, name, kind), REGISTRY[name]
    (effect,) = model.effects
    if not cls.mjcf_form:
        told = refusal(lambda: eq.export_model(tmp_path / "own.xml", model))
        assert f"MJCF cannot hold {name} at {effect.location} ({cls.mjcf_lacks})" in told
        assert f"--leave-out {name}@{effect.location} writes the rest" in told
        assert list(tmp_path.iterdir()) == []
        return
    off, change = [], 0.0
    for step in (STEP, FINE):
        own, whole, bare = both(model, tmp_path, step)
        off.append(np.abs(own - whole).max())
        change = np.abs(whole - bare).max()
    assert change > 0.03
    assert off[0] < min(2 * MOST_OFF if robots == "mjcf" else MOST_OFF, 0.05 * change)
    assert off[1] < max(0.5 * off[0], DIGITS * change)


def test_the_whole_catalogue_is_tried() -> None:
    assert {name for _, name, _ in CONTRACT} == set(OWN)
    assert all(REGISTRY[name].mjcf_form or REGISTRY[name].mjcf_lacks for name in OWN)


def test_an_effect_of_ones_own_is_refused_where_it_does_not_say_how_it_is_written(tmp_path: Path) -> None:
    @eq.register
    @dataclass(frozen=True)
    class Sticky(ForceEffect):
        """−size·rate³."""

        name = "sticky"
        robots = ("elastic", "mjcf")
        sits_at = ("joint",)
        summary = "a cubic drag"
        neutral = {"size": 0.0}  # noqa: RUF012
        size: float = parameter("N·m·s³/rad³", 0.0, 10.0, "of the drag")

        @classmethod
        def force(cls, x, rate, z, p):  # type: ignore[no-untyped-def]
            return -p["size"] * rate**3

    model = Model(LEG, (Sticky("knee", 0.1),))
    assert "cannot hold sticky at knee (MuJoCo has no such law)" in refusal(
        lambda: eq.export_model(tmp_path / "own.xml", model)
    )


def test_a_change_of_a_robot_that_no_xml_holds_is_refused_too(tmp_path: Path) -> None:
    """Of ones own, unless its class says that all it changes is in an XML."""

    @dataclass(frozen=True)
    class Ranged(BodyEffect):
        """Other ranges of commands, which nothing copies into a file."""

        name, summary, sits_at, robots = "ranged", "a drive with half the range", ("base",), ("mjcf",)
        share: float = parameter("1", 0.1, 1.0, "of the range")

        def changed(self, robot: Any, modelled: Any) -> Any:
            return replace(robot, xml=robot.xml.replace("0.1", f"{0.1 * self.share:g}"))

    @dataclass(frozen=True)
    class Heavier(Ranged):
        """Another mass, which is in a file."""

        name, mjcf_form = "heavier", "`mass`"

        def changed(self, robot: Any, modelled: Any) -> Any:
            return robot.with_parameters({"arm.mass": 2 * robot.parameters()["arm.mass"]})

    eq.register(Ranged)
    eq.register(Heavier)
    robot = MjcfRobot("p", pendulum())
    told = refusal(lambda: eq.export_model(tmp_path / "own.xml", Model(robot, (Ranged("base", 0.5),))))
    assert "cannot hold ranged at base (its class does not say" in told
    path = written(Model(robot, (Heavier("base", 0.5),)), tmp_path)
    found = mujoco.MjModel.from_xml_path(str(path)).body("arm").mass[0]
    assert found == pytest.approx(2 * robot.parameters()["arm.mass"])


# --- effects together ---------------------------------------------------------------------------------------------


def test_a_model_of_several_units_is_not_one_file(tmp_path: Path) -> None:
    model = Model(LEG).with_groups({"monday": {"calf.mass": 0.12}, "tuesday": {"calf.mass": 0.11}})
    told = refusal(lambda: eq.export_model(tmp_path / "a.xml", model))
    assert "has other parameters in monday, tuesday" in told and "in_group('monday')" in told
    assert eq.export_model(tmp_path / "a.xml", model.in_group("monday")).model.parameters()["calf.mass"] == 0.12


def test_effects_act_together(tmp_path: Path) -> None:
    """One of each kind that a leg's actuator can have at once, and more at joints."""
    strong = {name: CASES[name].strong for name in OWN}
    model = Model(
        LEG,
        (
            DeadZone("baa", 2e3), Saturation("baa", 1.3e4), Saturation("maa", 2.2e4), FirstOrderLag("maa", 0.05),
            *(make(name, "baa", strong[name]["actuator"]) for name in ("creep", "hysteresis", "transport_delay")),
            make("nonlinear_stiffness", "maa", {"cubic": 5e3, "centre": 0.15}),
            make("coulomb_friction", "knee", {"friction": 0.02}), make("parallel_spring", "hip", {"stiffness": 0.5, "rest": 1.0}),
            make("payload_mass", "foot", {"mass": 0.05}), make("sensor_scale", "knee", {"scale": 1.1}),
            make("sensor_delay", "knee", {"delay": 0.03}),
        ),
    )  # fmt: skip
    own, whole, bare = both(model, tmp_path, STEP)
    assert np.abs(own - whole).max() < MOST_OFF
    assert np.abs(bare - whole).max() > 0.1


@pytest.mark.parametrize("slow", [FirstOrderLag("baa", 0.1), RateLimit("baa", 3e4)], ids=lambda effect: effect.name)
@pytest.mark.parametrize("first", [True, False])
def test_a_dead_zone_takes_no_memory_behind_it(slow: Effect, first: bool, tmp_path: Path) -> None:
    """It is in the limits of the force, which come after filters: the same law in another order is another law."""
    pair = (DeadZone("baa", 2e3), slow)
    model = Model(LEG, pair if first else pair[::-1])
    told = refusal(lambda: eq.export_model(tmp_path / "own.xml", model))
    assert f"cannot hold {slow.name} at baa (" in told and "dead zone" in told and "dead_zone at" not in told


def test_a_lag_and_a_limited_rate_are_not_one_filter(tmp_path: Path) -> None:
    model = Model(LEG, (FirstOrderLag("baa", 0.1), RateLimit("baa", 3e4)))
    assert "rate_limit at baa (its actuator has a filter" in refusal(lambda: eq.export_model(tmp_path / "a.xml", model))


def test_a_saturation_at_the_lowest_command_is_refused(tmp_path: Path) -> None:
    model = Model(LEG, (Saturation("maa", 0.0),))
    assert "no more than the lowest command" in refusal(lambda: eq.export_model(tmp_path / "a.xml", model))


def test_what_is_shorter_than_a_step_is_refused(tmp_path: Path) -> None:
    model = Model(LEG, (make("transport_delay", "maa", {"delay": 1e-3}), make("sensor_delay", "hip", {"delay": 1e-3})))
    told = refusal(lambda: eq.export_model(tmp_path / "a.xml", model))
    assert "transport_delay at maa (it is shorter than a physics step" in told and "sensor_delay at hip (it" in told
    path = written(model, tmp_path, timestep=1e-3)
    assert mujoco.MjModel.from_xml_path(str(path)).actuator_delay[0] == 1e-3


# --- robots of one's own ------------------------------------------------------------------------------------------

DEVICES = {
    "springyield": pendulum('stiffness="6" springref="0.2" springyield="0.1"'),
    "polynomials": pendulum('damping="0.1 0.2 0.05" stiffness="2 0.5 0.3"'),
    "delay": pendulum(drive='<motor name="motor" joint="pivot" delay="0.03" nsample="30" interp="linear"/>'),
    "filter": pendulum(
        drive='<general name="motor" joint="pivot" dyntype="filterexact" dynprm="0.05" actearly="true"/>'
    ),
    "passive dcmotor": pendulum(
        drive='<motor name="motor" joint="pivot"/><dcmotor name="rub" joint="pivot" input="none" motorconst="0 0" '
        'resistance="1" cogging="0.4 6 0.3" lugre="40 0.2 0.5 0.8 0.1"/>'
    ),
    "driven dcmotor": pendulum(
        drive='<dcmotor name="motor" joint="pivot" motorconst="0.4 0.4" resistance="0.6" inductance="0 0.01" '
        'cogging="0.2 5 0"/>'
    ),
}
"""What MuJoCo 4 has of its own, in the XML of a robot."""


@pytest.mark.parametrize("more", [(), (make("payload_mass", "tip", {"mass": 0.4}),)], ids=["alone", "with a payload"])
@pytest.mark.parametrize("name", DEVICES)
def test_what_an_xml_has_of_its_own_stays(name: str, more: tuple[Effect, ...], tmp_path: Path) -> None:
    """Compared with plain MuJoCo on the robot's own XML where nothing is added, else with the package's simulation."""
    robot = MjcfRobot("p", DEVICES[name])
    model = Model(robot, more)
    path = written(model, tmp_path)
    times = np.arange(0.0, 2.0, 0.25)
    commands = 3 * np.sin(2.3 * times)[:, None]
    start = begins(path, robot.joint_names)
    trial = Trial("t", times, commands, np.zeros(1), 0.0, start, np.arange(0.0, 2.001, 0.02))
    own = played(path, trial, robot.joint_names, robot.actuator_names)
    (tmp_path / "before.xml").write_text(DEVICES[name])
    before = played(tmp_path / "before.xml", trial, robot.joint_names, robot.actuator_names)
    if more:
        (found,) = simulate_mjcf([model], [trial], threads=1)
        assert np.abs(own - before).max() > 0.01
        np.testing.assert_allclose(own, found.position[0], rtol=0, atol=2e-3)
    else:
        np.testing.assert_allclose(own, before, rtol=0, atol=2e-5)


@pytest.mark.parametrize(
    "drive", ['<motor name="motor" site="tip" gear="0 0 1"/>', '<motor name="motor" joint="pivot"/>']
)
def test_a_constant_force_needs_no_drive(drive: str, tmp_path: Path) -> None:
    robot = MjcfRobot("p", pendulum(drive=drive))
    model = Model(robot, (make("asymmetric_friction", "pivot", {"forward": 0.9, "backward": 0.2}),))
    path = written(model, tmp_path)
    passive = mujoco.MjModel.from_xml_path(str(path)).nactuator - 1
    assert passive == ("site" in drive)
    start = begins(path, robot.joint_names)
    times = np.arange(0.0, 2.0, 0.25)
    trial = Trial("t", times, 4 * np.sin(2 * times)[:, None], np.zeros(1), 0.0, start, np.arange(0.0, 2.001, 0.02))
    (found,) = simulate_mjcf([model], [trial], threads=1)
    own = played(path, trial, robot.joint_names, robot.actuator_names)
    np.testing.assert_allclose(own, found.position[0], rtol=0, atol=2e-5)


LIMITED = 'actuatorfrclimited="true" actuatorfrcrange="-1 1"'
OFF = '<flag actuation="disable"/>'


@pytest.mark.parametrize(("text", "why"), [(pendulum(LIMITED), "limits"), (pendulum(option=OFF), "switches actuators")])
@pytest.mark.parametrize("name", ["torque_ripple", "dahl_friction", "constant_force"])
def test_devices_that_something_would_bound_are_refused(name: str, text: str, why: str, tmp_path: Path) -> None:
    model = Model(MjcfRobot("p", text), (make(name, "pivot", CASES[name].mjcf or {}),))
    assert f"cannot hold {name} at pivot (the file {why}" in refusal(lambda: eq.export_model(tmp_path / "a.xml", model))


def test_a_file_that_is_written_again_has_a_device_of_each(tmp_path: Path) -> None:
    """Names that are taken are numbered, and keyframes have a value for every state."""
    keyed = pendulum(tail='<keyframe><key name="up" qpos="3" ctrl="0.5"/></keyframe>')
    ripple, lag = make("torque_ripple", "pivot", CASES["torque_ripple"].mjcf or {}), FirstOrderLag("motor", 0.1)
    dahl = make("dahl_friction", "pivot", {"friction": 0.2, "distance": 0.1})
    first = written(Model(MjcfRobot("p", keyed), (ripple, dahl, lag)), tmp_path)
    again = written(Model(eq.load_model(first).robot, (ripple,)), tmp_path)
    model = mujoco.MjModel.from_xml_path(str(again))
    assert [model.actuator(k).name for k in range(model.nactuator)] == [
        "motor", "pivot torque_ripple", "pivot dahl_friction", "pivot torque_ripple 2",
    ]  # fmt: skip
    assert model.nu == 1 and model.key_act.tolist() == [[0.5, 0.0]]


def test_measurements_of_a_file_that_is_written_again_have_names_of_their_own(tmp_path: Path) -> None:
    """Tendons and sensors that are called as new ones would be keep their names."""
    scale, late = make("sensor_scale", "pivot", {"scale": 1.1}), make("sensor_delay", "pivot", {"delay": 0.03})
    first = written(Model(MjcfRobot("p", pendulum()), (scale, late)), tmp_path)
    again = written(Model(eq.load_model(first).robot, (make("sensor_scale", "pivot", {"scale": 1.2}),)), tmp_path)
    model = mujoco.MjModel.from_xml_path(str(again))
    assert [model.tendon(k).name for k in range(model.ntendon)] == ["pivot measured", "pivot measured 2"]
    assert [model.sensor(k).name for k in range(model.nsensor)] == ["pos.pivot", "pos.pivot 2"]
    other = pendulum(tail='<sensor><jointvel name="pos.pivot" joint="pivot"/></sensor>')
    path = written(Model(MjcfRobot("p", other), (late,)), tmp_path)
    model = mujoco.MjModel.from_xml_path(str(path))
    assert [model.sensor(k).name for k in range(model.nsensor)] == ["pos.pivot", "pos.pivot 2"]
    assert model.sensor_delay.tolist() == [0.0, 0.03]


@pytest.mark.parametrize("interp", [0, 1, 2])
@pytest.mark.parametrize(("delay", "step"), [(0.03, None), (4e-4, None), (4e-3, 5e-3)])
def test_delays_of_an_xml_stay_as_they_are(delay: float, step: float | None, interp: int, tmp_path: Path) -> None:
    """Shorter than a step too, and however a buffer is read; with more they are as long as a step at least."""
    kind = ("zoh", "linear", "cubic")[interp]
    drive = f'<motor name="motor" joint="pivot" delay="{delay}" nsample="30" interp="{kind}"/>'
    robot = MjcfRobot("p", pendulum(drive=drive))
    model = mujoco.MjModel.from_xml_path(str(written(Model(robot), tmp_path, timestep=step)))
    assert model.actuator_delay.tolist() == [delay] and model.actuator_history[0].tolist() == [30, interp]
    more = Model(robot, (make("transport_delay", "motor", {"delay": 3e-4}),))
    if delay + 3e-4 >= model.opt.timestep:
        path = written(more, tmp_path, timestep=step)
        assert mujoco.MjModel.from_xml_path(str(path)).actuator_delay.tolist() == [pytest.approx(delay + 3e-4)]
        return
    told = refusal(lambda: eq.export_model(tmp_path / "a.xml", more, timestep=step))
    assert "transport_delay at motor (" in told and "a smaller --timestep holds it" in told


@pytest.mark.parametrize("off", [0, -1, 1])
@pytest.mark.parametrize("group", [-1, 0, 30, 31, 40])
def test_groups_of_actuators_are_what_they_are_to_mujoco(group: int, off: int, tmp_path: Path) -> None:
    """Those beyond 0 to 30 are never switched off: the constant force goes to the drive where it acts."""
    drive = f'<motor name="motor" joint="pivot" group="{group}"/>'
    robot = MjcfRobot("p", pendulum(drive=drive))
    draft = Draft(robot.mujoco_model(None))
    draft.model.opt.disableactuator = off
    data = mujoco.MjData(draft.model)
    data.ctrl[0] = 1.0
    mujoco.mj_forward(draft.model, data)
    acts = data.actuator_force[0] != 0
    assert add_constant_force(draft, "pivot", 0.3, "push") == ""
    assert (draft.model.actuator_biasprm[0, 0] != 0) == acts and bool(draft.edits) == (not acts)


# --- the verb -----------------------------------------------------------------------------------------------------


@pytest.fixture
def leg_with_play(tmp_path: Path) -> Path:
    model = Model(
        LEG, (make("backlash", "knee", {"play": 0.02}), make("creep", "maa", CASES["creep"].strong["actuator"]))
    )
    eq.save_model(tmp_path / "leg.toml", model)
    return tmp_path / "leg.toml"


def test_the_verb_refuses_what_mjcf_cannot_hold(leg_with_play: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = leg_with_play.with_name("out.xml")
    assert main(["export", str(leg_with_play), "--output", str(output)]) == 2
    told = capsys.readouterr().err
    assert "MJCF cannot hold backlash at knee (MuJoCo's sensors have no play)" in told and "creep" not in told
    assert not output.exists()


def test_the_verb_leaves_out_what_it_is_told_to(leg_with_play: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = leg_with_play.with_name("out.xml")
    words = ["export", str(leg_with_play), "-o", str(output), "--leave-out", "backlash@knee", "--json"]
    assert main(words) == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert found["left_out"] == [{"effect": "backlash", "location": "knee", "play": 0.02}]
    (creep,) = found["effects"]
    assert creep["effect"] == "creep" and creep["written_as"] == REGISTRY["creep"].mjcf_form
    assert "left out: backlash at knee" in said.err
    assert "<!-- Not in here: backlash at knee. -->" in output.read_text()
    assert main(words) == 2 and "is there already" in capsys.readouterr().err
    assert main([*words, "--force"]) == 0


def test_the_verb_takes_robots_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By --model or by name, with what is held and left out of it; the default name is the robot's."""
    monkeypatch.chdir(tmp_path)
    Path("robot.xml").write_text(ARM)
    assert main(["export", "robot.xml", "--ignore", "drive", "--lock", "reach"]) == 0
    text = Path("crane.xml").read_text()
    assert "Not in here: drive, which is ignored." in text and 'name="reach"' not in text
    assert main(["export", "--model", "robot.xml", "-o", "crane.xml", "--force", "--timestep", "0.0005"]) == 0
    assert mujoco.MjModel.from_xml_path("crane.xml").opt.timestep == 0.0005


@pytest.mark.parametrize("read", ["crane.xml", "by.toml", "link.xml"])
def test_the_verb_never_writes_over_what_it_reads(
    read: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By its default name, through a model file that names it, and through a link."""
    monkeypatch.chdir(tmp_path)
    Path("crane.xml").write_text(ARM)
    Path("link.xml").symlink_to("crane.xml")
    (tmp_path / "by").mkdir()
    eq.save_model("by.toml", eq.load_model("crane.xml"), near=Path("crane.xml"))
    for words in (["--force"], ["--force", "-o", "crane.xml"], ["--force", "-o", "by/../crane.xml"]):
        assert main(["export", read, *words]) == 2
        assert "which would be lost; expected another name" in capsys.readouterr().err
        assert Path("crane.xml").read_text() == ARM
    assert main(["export", read, "-o", "by/crane.xml"]) == 0
    assert main(["export", read, "-o", "by/crane.xml", "--force"]) == 0


WRONG = [
    (["export", "a.toml", "--model", "b.toml"], "the model is a.toml and also --model b.toml"),
    (["export", "-o", "leg.toml"], "expected a name that ends in .xml"),
    (["export", "--format", "sdf"], "there is no format 'sdf'"),
    (["export", "--timestep", "1"], "the physics step is 1 s, expected 1e-05 to 0.05"),
    (["export", "--timestep", "nan"], "the physics step is nan s"),
    (["export", "--leave-out", "crep"], "there is no effect 'crep'"),
]


@pytest.mark.parametrize(("words", "sentence"), WRONG)
def test_what_is_wrong_is_a_sentence(
    words: list[str], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    told = capsys.readouterr().err
    assert sentence in told and told.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


# --- the page -----------------------------------------------------------------------------------------------------


def test_the_page_says_of_every_effect_how_it_is_written() -> None:
    """Each row of the tables is an effect's own words, and no effect lacks one."""
    page = (Path(__file__).parents[1] / "docs" / "export.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", page, flags=re.MULTILINE))
    assert rows == {name: REGISTRY[name].mjcf_form or REGISTRY[name].mjcf_lacks for name in OWN}
