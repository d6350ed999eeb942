"""The effect that puts a joint's end stop elsewhere: which side, how many, and that everything follows it."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from morphologies import pendulum

from equimus_ctrl.effects import GravityTilt, ParallelSpring, PayloadMass, TransportDelay
from equimus_ctrl.effects.bodies import JointStop, changed_bodies
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS
from equimus_ctrl.engines.mujoco_trials import simulate_mujoco
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.parameters import default_bounds, free_parameters, unit_of
from equimus_ctrl.identification.statics import fit_static, pressed, rest_poses
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model, model_from_dict, model_to_dict
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import JointStop as Stop
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase
from equimus_ctrl.types import Array

LEG = nominal_leg()
LOW, HIGH = JointStop("knee", 0.6, 15.0, 0.02), JointStop("knee", 1.1, 60.0, 0.05)


def stops(m: Morphology, joint: str) -> tuple[Stop | None, Stop | None]:
    return m.joint(joint).lower, m.joint(joint).upper


def with_stops(m: Morphology, joint: str, **sides: Stop | None) -> Morphology:
    return replace(m, joints=tuple(replace(j, **sides) if j.name == joint else j for j in m.joints))  # type: ignore[arg-type]


def test_it_replaces_the_stop_on_the_side_it_lies_on() -> None:
    knee = LEG.joint("knee")
    assert stops(changed_bodies((LOW,), LEG), "knee") == (Stop(0.6, 15.0, 0.02), knee.upper)
    assert stops(changed_bodies((HIGH,), LEG), "knee") == (knee.lower, Stop(1.1, 60.0, 0.05))
    middle = (-0.035 + 2.0) / 2
    for angle, side in ((math.nextafter(middle, 0), 0), (middle, 1), (-6.0, 0), (6.0, 1)):
        found = stops(changed_bodies((JointStop("knee", angle, 1.0, 0.0),), LEG), "knee")
        assert found[side] == Stop(angle, 1.0, 0.0)
        assert found[1 - side] == (knee.upper, knee.lower)[side]


@given(
    st.permutations([LOW, JointStop("knee", 0.99, 60.0, 0.5), GravityTilt("base", 0.7), JointStop("hip", 1.6, 1, 1)])
)
def test_the_side_is_that_on_the_modelled_robot_whatever_came_before(order: list[JointStop | GravityTilt]) -> None:
    """0.99 lies above the middle of the modelled range, but below that of the range that the other stop leaves."""
    robot = changed_bodies(order, LEG)
    assert stops(robot, "knee") == (Stop(0.6, 15.0, 0.02), Stop(0.99, 60.0, 0.5))
    assert robot.tilt == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("sides", "middle"),
    [
        ({"lower": Stop(0.4), "upper": Stop(1.0)}, 0.7),
        ({"lower": Stop(0.4), "upper": None}, 0.4 + math.pi / 2),
        ({"lower": None, "upper": Stop(0.4)}, 0.4 - math.pi / 2),
    ],
)
def test_a_stop_that_is_not_modelled_is_half_a_turn_from_the_other(
    sides: dict[str, Stop | None], middle: float
) -> None:
    m = with_stops(LEG, "knee", **sides)
    assert m.middle("knee") == pytest.approx(middle)
    low = changed_bodies((JointStop("knee", middle - 0.01, 5.0, 0.0),), m).joint("knee")
    assert low.lower == Stop(middle - 0.01, 5.0, 0.0)
    assert low.upper == sides["upper"]


def test_without_any_stop_the_sides_meet_where_the_joint_hangs() -> None:
    m = with_stops(with_stops(LEG, "knee", lower=None, upper=None), "hip", lower=None, upper=None)
    assert (m.middle("hip"), m.middle("knee")) == (math.pi / 2, 0.0)
    assert replace(m, tilt=0.2).middle("hip") == pytest.approx(math.pi / 2 + 0.2)
    assert changed_bodies((JointStop("hip", 1.2, 5.0, 0.0),), m).joint("hip").lower == Stop(1.2, 5.0, 0.0)


def test_a_joint_can_have_one_on_each_side_and_no_more() -> None:
    Model(LEG, (LOW, HIGH, JointStop("hip", 1.0, 1.0, 1.0)))
    for pair in itertools.permutations([LOW, JointStop("knee", 0.2, 1.0, 1.0)]):
        with pytest.raises(ConfigError) as caught:
            Model(LEG, pair)
        assert str(caught.value) == (
            "nominal_leg: 'knee, lower side' has two effects that exclude each other, joint_stop and joint_stop"
        )


# --- names of several effects of one kind at one place ------------------------------------------------------------


def test_two_of_one_name_at_one_place_keep_their_own_numbers() -> None:
    model = Model(LEG, (LOW, HIGH, TransportDelay("maa", 0.1), TransportDelay("maa", 0.05)))
    values = model.parameters()
    assert (values["knee.joint_stop.angle"], values["knee.joint_stop#2.angle"]) == (0.6, 1.1)
    assert (values["maa.transport_delay.delay"], values["maa.transport_delay#2.delay"]) == (0.1, 0.05)
    moved = model.with_parameters({"knee.joint_stop#2.stiffness": 70.0, "maa.transport_delay.delay": 0.2})
    assert moved.effects == (LOW, replace(HIGH, stiffness=70.0), TransportDelay("maa", 0.2), model.effects[3])
    assert model.with_parameters(values) == model
    assert model_from_dict(model_to_dict(model)) == model
    free = free_parameters(model, ["knee.joint_stop*"])
    assert len(free.names) == 6
    assert free.model_at(free.start) == model
    assert unit_of(model, "knee.joint_stop#2.damping") == "N·m·s/rad"


def test_a_search_does_not_take_a_stop_to_the_other_side() -> None:
    model = Model(LEG, (LOW, HIGH))
    middle = LEG.middle("knee")
    low, high = default_bounds(model, "knee.joint_stop.angle"), default_bounds(model, "knee.joint_stop#2.angle")
    assert low[0] == -6.3 and middle - 1e-12 < low[1] < middle
    assert high == (middle, 6.3)
    for angle, other in itertools.product(low, high):
        model.with_parameters({"knee.joint_stop.angle": angle, "knee.joint_stop#2.angle": other})
    assert default_bounds(model, "knee.joint_stop.stiffness") == (0.0, 1e4)


# --- everything follows -------------------------------------------------------------------------------------------


def moving(phase: Phase) -> Trial:
    """A leg that starts in one stop of its knee and swings, or falls, into the other."""
    commands = np.array([[12e3, 2e3], [4e3, 20e3], [20e3, 0.0], [5e3, 14e3]]) * (1.0 if phase == "swing" else 0.4)
    start, samples = np.array([1.3, 1.2 if phase == "swing" else 0.5]), 192 if phase == "swing" else 42
    return Trial("t", np.arange(4) * 0.4, commands, commands[0], 0.0, start, np.arange(samples) / 120)


@pytest.mark.parametrize(
    ("effects", "phase"),
    [((LOW,), "swing"), ((HIGH, PayloadMass("thigh", 0.1)), "swing"), ((LOW, HIGH), "swing"), ((LOW, HIGH), "stance")],
)
def test_both_engines_move_the_leg_between_its_new_stops(effects: tuple[JointStop, ...], phase: Phase) -> None:
    trial, models = moving(phase), [Model(LEG, effects, phase), Model(LEG, phase=phase)]
    exact = simulate(models, [trial], dt=1e-4, threads=1)[0].position
    assert np.abs(exact[0] - exact[1]).max() > 0.02
    fine = replace(FAST_SETTINGS, timestep=1 / 1920)
    found = simulate_mujoco(models, [trial], settings=fine, threads=1)[0].position
    np.testing.assert_allclose(found[0], exact[0], rtol=0, atol=1e-4)
    # Beside an effect that pushes, runs are stepped one by one.
    spring = ParallelSpring("hip", 0.0, 0.0)
    stepped = simulate_mujoco([Model(LEG, (*effects, spring), phase)], [trial], settings=fine, threads=1)[0].position
    np.testing.assert_allclose(stepped[0], exact[0], rtol=0, atol=1e-4)


def test_models_with_a_stop_where_others_have_none_run_together() -> None:
    bare = with_stops(LEG, "knee", lower=None, upper=None)
    models = [Model(bare), Model(bare, (JointStop("knee", -0.1, 50.0, 0.05),)), Model(bare, (HIGH,))]
    trial = moving("swing")
    trial = replace(trial, commands=np.array([[0.0, 40e3]] * 4))
    fine = replace(FAST_SETTINGS, timestep=1 / 1920)
    expected = simulate(models, [trial], dt=1e-4, threads=1)[0].position
    found = simulate_mujoco(models, [trial], settings=fine, threads=1)[0].position
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)
    assert np.abs(expected[0] - expected[1]).max() > 0.01


def test_a_leg_rests_on_its_new_stop_in_statics() -> None:
    pressure = np.array([[10e3, 30e3]])
    model = Model(LEG, (JointStop("knee", 0.5, 20.0, 0.0),))
    robot = changed_bodies(model.effects, LEG)
    rest = Kinematics(robot).equilibrium(pressure[0])
    found = rest_poses(model, pressure, rest[None] + 0.01)
    assert found.found[0]
    np.testing.assert_allclose(found.angles[0], rest, atol=1e-8)
    assert rest[1] < 0.5
    assert Kinematics(LEG).equilibrium(pressure[0])[1] < rest[1] - 0.05
    assert pressed(model, rest[None])[0] and not pressed(Model(LEG), rest[None])[0]


BARE = with_stops(with_stops(LEG, "knee", lower=None, upper=None), "hip", lower=None, upper=None)
SOFT = Model(LEG, (JointStop("knee", 0.6, 20.0, 0.0),))


@pytest.mark.parametrize(
    ("model", "names"),
    [(SOFT, ["knee.joint_stop.angle", "knee.joint_stop.stiffness"]), (Model(BARE), ["maa.stiffness", "baa.stiffness"])],
)
def test_poses_at_rest_give_a_stop_and_do_without_any(model: Model, names: list[str]) -> None:
    pressure = np.array([[10e3, 30e3], [12e3, 24e3], [14e3, 20e3], [8e3, 6e3], [9e3, 9e3], [12e3, 12e3], [6e3, 4e3]])
    found = rest_poses(model, pressure, np.tile([1.35, 0.55], (len(pressure), 1)))
    pressure, poses = pressure[found.found], found.angles[found.found]
    assert len(poses) > 4
    truth = {name: model.parameters()[name] for name in names}
    start = model.with_parameters({name: 1.05 * value for name, value in truth.items()})
    fitted = fit_static(free_parameters(start, names), pressure, poses)
    np.testing.assert_allclose(fitted.theta, list(truth.values()), rtol=1e-5)


@pytest.mark.parametrize(("stiffness", "damping"), [(1e3, 0.0), (200.0, 5.0), (9e3, 20.0)])
def test_steps_are_divided_while_a_stop_is_pressed(stiffness: float, damping: float) -> None:
    hard = Model(LEG, (JointStop("knee", 0.6, stiffness, damping),))
    coarse, fine = (simulate([hard], [moving("swing")], dt=dt, threads=1)[0].position[0] for dt in (2e-3, 5e-5))
    assert (fine[:, 1] < 0.6).any()
    np.testing.assert_allclose(coarse, fine, atol=5e-4)


def test_a_step_too_long_for_a_stop_is_said() -> None:
    hard = Model(LEG, (JointStop("knee", 0.6, 200.0, 20.0),))
    with pytest.warns(UserWarning, match="a joint stop was touched, and a physics step of 4 ms is too long"):
        simulate([hard], [moving("swing")], dt=4e-3, threads=1)


def fall(model: Model, start: float) -> Array:
    trial = Trial("t", np.zeros(1), np.zeros((1, 1)), np.zeros(1), 0.0, np.array([start]), np.array([0.0, 8.0]))
    return simulate([model], [trial], threads=1)[0].position[0]


def test_a_pendulum_without_stops_gets_one() -> None:
    rod = pendulum()
    rod = replace(rod, joints=(replace(rod.joints[0], damping=0.5),))
    model = Model(rod, (JointStop("pivot", 1.2, 400.0, 1.0),))
    assert fall(Model(rod), 1.0)[-1, 0] == pytest.approx(math.pi / 2, abs=1e-4)
    assert changed_bodies(model.effects, rod).joint("pivot").lower is not None
    upper = Model(rod, (JointStop("pivot", 1.7, 400.0, 1.0),))
    assert fall(upper, 1.8)[-1, 0] == pytest.approx(math.pi / 2, abs=1e-4)
