"""The sampling controller of any robot: what it rolls out, what plans are made of, what it reaches and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mjcf_models import RIG, pendulum, refusal
from scipy.linalg import expm

from equimus_ctrl import presets, workflow
from equimus_ctrl.controllers.registry import make_controller
from equimus_ctrl.controllers.sampling import SamplingController, SamplingState
from equimus_ctrl.controllers.sampling_policies import PolicyState
from equimus_ctrl.controllers.sampling_settings import SamplingSettings
from equimus_ctrl.effects import FirstOrderLag, PayloadMass, StribeckFriction, TransportDelay
from equimus_ctrl.engines.mjcf_realised import realise
from equimus_ctrl.estimation.predicted import Known, Predicted
from equimus_ctrl.loop import run
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.predictive.energy import Energy
from equimus_ctrl.predictive.forward import ExactForward, MujocoForward, can_touch, make_forward, slopes_of
from equimus_ctrl.predictive.measures import measures_of
from equimus_ctrl.predictive.policies import Plans, Valves, drawn, settler
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.scenarios.references import HoldReference
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.scenarios.scoring import ArrivalFigures, score_run
from equimus_ctrl.types import Array, Run, Start

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
CARTPOLE, ACROBOT = (workflow.load_model(EXAMPLES / f"{name}.xml") for name in ("cartpole", "acrobot"))
UPRIGHT = np.zeros(2)
BOUNCER = MjcfRobot(
    "bouncer",
    """<mujoco model="bouncer"><option timestep="0.005"/><worldbody><geom name="floor" type="plane" size="1 1 1"/>
    <body pos="0 0 0.2"><joint name="up" type="slide" axis="0 0 1"/><geom name="ball" size="0.1" mass="1"/></body>
    </worldbody><actuator><motor name="lift" joint="up" ctrlrange="-20 20"/></actuator></mujoco>""",
)
FEW = SamplingSettings(samples=32, compiled=False)


def balanced(model: Model, *, seconds: float = 0.6, seed: int = 0, settings: SamplingSettings = FEW) -> Run:
    """A pole that begins 3° off upright."""
    plant = MujocoPlant(model, noise=1e-3)
    start = Start(command=[0.0], position=[0.0, np.radians(3.0)])
    own = SamplingController(replace(settings, seed=seed))
    return run(plant, own, HoldReference(UPRIGHT), seconds, start=start, seed=seed)


# --- rollouts -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [CARTPOLE, ACROBOT], ids=lambda model: model.name)
def test_both_ways_to_roll_out_are_the_plant(model: Model) -> None:
    rng, plant = np.random.default_rng(1), MujocoPlant(model)
    dt = plant.spec.control_dt
    ways = [ExactForward(model, 3, dt, compiled=False), MujocoForward(model, 3, dt, "")]
    for _ in range(5):
        q, v, u = rng.uniform(-1, 1, 2), rng.uniform(-3, 3, 2), rng.uniform(-1, 1, 1)
        plant.reset(Start(command=u, position=q, velocity=v))
        plant.step(u)
        moved = np.concatenate([plant.position, plant.data.qvel])
        for way, near in zip(ways, (1e-7, 1e-12), strict=True):
            begun = np.tile(way.begin(q, v, u), (3, 1))
            after = way.joints(way(begun, np.tile(u, (3, 1))))
            np.testing.assert_allclose(after, np.tile(moved, (3, 1)), atol=near)


def test_the_end_of_a_joint_is_in_both() -> None:
    dt = MujocoPlant(CARTPOLE).spec.control_dt
    found = []
    for way in (ExactForward(CARTPOLE, 1, dt, compiled=False), MujocoForward(CARTPOLE, 1, dt, "")):
        x = way.begin(np.array([1.7, 0.0]), np.array([3.0, 0.0]), np.zeros(1))[None]
        for _ in range(30):
            x = way(x, np.zeros((1, 1)))
        found.append(way.joints(x)[0])
    assert found[0][2] < 0 and found[1][2] < 0, "it has turned back"
    np.testing.assert_allclose(found[0], found[1], atol=0.05)


def test_the_choice_follows_from_what_the_robot_has_and_is_said() -> None:
    assert make_forward(CARTPOLE, 4, 0.01, compiled=False).name == "exact"
    touching = make_forward(Model(BOUNCER), 4, 0.01)
    assert touching.name == "mujoco" and touching.why == "it has contacts (floor may touch ball)"
    rubbed = make_forward(Model(MjcfRobot("rubbed", pendulum('frictionloss="0.1"'))), 4, 0.01)
    assert (rubbed.name, rubbed.why) == ("mujoco", "it has dry friction")
    said = refusal(lambda: make_forward(Model(BOUNCER), 4, 0.01, "exact"))
    assert said == "engine is 'exact', which does not hold contacts (floor may touch ball) of bouncer; expected 'auto'"


def test_geoms_of_a_body_and_its_parent_do_not_touch() -> None:
    assert can_touch(realise(Model(BOUNCER)).mujoco)
    xml = BOUNCER.xml.replace('name="floor"', 'name="floor" contype="0" conaffinity="0"')
    assert not can_touch(realise(Model(MjcfRobot("free", xml))).mujoco)
    hinged = """<body name="b" pos="0 0 1"><joint name="second" axis="0 1 0"/><geom name="g" size="0.1"/></body>"""
    nested = xml.replace("</body>", f"{hinged}</body>")
    assert not can_touch(realise(Model(MjcfRobot("nested", nested))).mujoco)
    deeper = nested.replace(
        'size="0.1"/></body>', 'size="0.1"/><body><joint name="third"/><geom name="h" size="0.1"/></body></body>'
    )
    assert can_touch(realise(Model(MjcfRobot("deeper", deeper))).mujoco) == "contacts (ball may touch h)"
    named = deeper.replace('<body><joint name="third"', '<body name="c"><joint name="third"')
    named = named.replace('<body pos="0 0 0.2">', '<body name="a" pos="0 0 0.2">')
    for pair in (("a", "c"), ("c", "a")):
        apart = named.replace("</mujoco>", '<contact><exclude body1="{}" body2="{}"/></contact></mujoco>'.format(*pair))
        assert not can_touch(realise(Model(MjcfRobot("apart", apart))).mujoco)


def test_a_rollout_that_mujoco_gives_up_is_lost_and_not_repeated() -> None:
    way = MujocoForward(CARTPOLE, 2, 0.01, "")
    begun = np.tile(way.begin(UPRIGHT, UPRIGHT, np.zeros(1)), (2, 1))
    begun[1, 3:] = 1e11
    after = way(begun, np.zeros((2, 1)))
    assert np.isfinite(after[0]).all() and np.isnan(after[1]).all()
    again = way(after, np.zeros((2, 1)))
    assert np.isfinite(again[0]).all() and np.isnan(again[1]).all()


def test_a_law_that_mujoco_has_no_field_for_is_refused() -> None:
    law = StribeckFriction("slider", 0.5, 0.3, 0.1)
    plant = MujocoPlant(CARTPOLE, nominal=Model(CARTPOLE.robot, (law,)))
    said = refusal(lambda: SamplingController(FEW).init(plant.spec, plant.reset()))
    assert "stribeck_friction at slider is not simulated in many rollouts at once" in said


# --- scales, energy, regulators -----------------------------------------------------------------------------------


def test_scales_come_from_ranges_and_the_motion_about_the_pose() -> None:
    spec, forward = MujocoPlant(CARTPOLE).spec, ExactForward(CARTPOLE, 1, 0.01, compiled=False)
    found = measures_of(spec, UPRIGHT, forward, Dynamics(CARTPOLE))
    np.testing.assert_allclose(found.position, [1.8, np.pi])
    assert found.turning.tolist() == [False, True] and found.command.tolist() == [1.0]
    # A pole of 1 m with its mass in the middle, on a cart ten times as heavy, falls with this rate.
    assert found.rate == pytest.approx(3.906, rel=1e-3)
    off = found.errors(np.array([3.0, 2 * np.pi + 0.1, 0, 0]), np.zeros(4))
    np.testing.assert_allclose(off[:2], [3.0, 0.1])


def test_a_hinge_with_a_spring_does_not_turn_freely() -> None:
    for joint, freely in (("", True), ('stiffness="0.1"', False)):
        model = Model(MjcfRobot("hinge", pendulum(joint)))
        forward = ExactForward(model, 1, 0.008, compiled=False)
        found = measures_of(MujocoPlant(model).spec, np.zeros(1), forward, Dynamics(model))
        assert found.turning.tolist() == [freely]


def test_energy_is_kept_without_drives_and_changes_by_their_power() -> None:
    free = Model(MjcfRobot("free", ACROBOT.robot.xml.replace('damping="0.05"', 'damping="0"')))
    energy, forward = Energy(free, 2, compiled=False), ExactForward(free, 1, 0.001, compiled=False)
    x = np.array([[1.0, -0.7, 0.5, 2.0]])
    values, power = energy(x)
    kept = forward(x, np.zeros((1, 1)))
    assert energy(kept)[0] == pytest.approx(values, abs=1e-7)
    driven = (energy(forward(x, np.full((1, 1), 0.3)))[0] - values) / 0.001
    np.testing.assert_allclose(driven, 0.3 * power[:, 0], rtol=2e-2)
    # Both poles from hanging to upright: 1 kg by 1 m, 1 kg by 3 m.
    span = energy.span(UPRIGHT, np.full(2, np.pi), np.full(2, -np.inf), np.full(2, np.inf))
    assert span == pytest.approx(9.81 * 4, rel=1e-6)


@pytest.mark.parametrize("late", [0.0, 0.013, 0.02])
def test_what_a_regulator_costs_is_what_its_motion_costs(late: float) -> None:
    dt, scale, effort = 0.01, np.array([1.0, 2.0, 3.0, 4.0]), np.array([0.5])
    valve = np.array([[late, 0, 0, np.inf, np.inf, 0]])
    valves, linear = Valves(valve, dt, lambda rows: rows), Dynamics(CARTPOLE).linear(UPRIGHT)
    found = settler(linear, valves, dt, scale, effort)
    assert found is not None
    a, b = linear.matrices()
    x, sent, cost = np.array([0.1, 0.05, 0.0, 0.0]), np.zeros((valves.memory + 1, 1)), 0.0
    begun = x.copy()
    fine = 50
    for _ in range(2000):
        u = -found.gain @ np.concatenate([x, sent[1:].ravel()])
        sent = np.vstack([sent[1:], u[None]])
        cost += 0.5 * dt * (((x / scale) ** 2).sum() + ((u / effort) ** 2).sum())
        arriving = valves.arriving(sent[None])[0]
        for _ in range(fine):
            middle = x + dt / fine / 2 * (a @ x + b @ arriving)
            x = x + dt / fine * (a @ middle + b @ arriving)
    assert np.abs(x).max() < 1e-4
    assert cost == pytest.approx(0.5 * begun @ found.cost @ begun, rel=1e-3)


def test_there_is_no_regulator_where_actuators_cannot_make_a_pose_stable() -> None:
    xml = CARTPOLE.robot.xml.replace('joint="slider" gear="10"', 'joint="aside" gear="10"')
    beside = '<body name="b"><joint name="aside" type="slide" axis="0 1 0"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'
    model = Model(MjcfRobot("apart", xml.replace('<body name="cart">', f'{beside}<body name="cart">')))
    linear = Dynamics(model).linear(np.zeros(3))
    valves = Valves(realise(model).valve, 0.01, lambda rows: rows)
    assert settler(linear, valves, 0.01, np.ones(6), np.ones(1)) is None
    spec = MujocoPlant(model).spec
    own = SamplingController(FEW)
    observation = MujocoPlant(model).reset(Start(command=[0.0], position=np.zeros(3)))
    _, state = own.step(observation, HoldReference(np.zeros(3)), own.init(spec, observation))
    assert "no regulator ends them, for the actuators cannot make the robot stable about the wanted pose" in state.note


# --- plans --------------------------------------------------------------------------------------------------------


def test_the_nominal_plan_is_tried_first_and_all_is_left_to_regulators_after_it() -> None:
    rng = np.random.default_rng(0)
    nominal = replace(Plans.none(5, 1), settled=np.array([0.7]), raised=np.array([0.2]))
    found = drawn(rng, nominal, rng.standard_normal((64, 5, 1)), 2.0, True, 2)
    assert (found.settled[0], found.raised[0]) == (0.7, 0.2)
    assert found.settled[1:3].tolist() == [0.0, 0.0] and found.regulator[1:3].tolist() == [0, 1]
    assert np.isneginf(found.raised[1:3]).all()
    alike = (found.settled == 0.7) & (found.raised == 0.2)
    assert 0.4 < alike.mean() < 0.6, "half differ in their knots alone"
    bare = drawn(rng, Plans.none(5, 1), rng.standard_normal((64, 5, 1)), 2.0, False, 0)
    assert np.isinf(bare.settled).all() and np.isneginf(bare.raised).all()


def test_dead_times_are_shares_of_commands() -> None:
    valve = np.tile([0.0, 0, 0, np.inf, np.inf, 0], (3, 1))
    valve[:, 0] = [0.0, 0.025, 0.01]
    valves = Valves(valve, 0.01, lambda rows: rows)
    assert valves.memory == 3 and not valves.lagging
    sent = np.arange(4.0)[None, :, None] * np.ones(3)
    np.testing.assert_allclose(valves.arriving(sent), [[3.0, 0.5, 2.0]])


# --- what is known ------------------------------------------------------------------------------------------------


def filtered(own: Predicted, slopes: Array, y: Array, dt: float, x: Array) -> tuple[Array, Known]:
    """(n, 2) what is known of a joint from an x on, of a model that is its slopes, and what is known last."""
    known, found = own.begin(x, x[:1], 0.0, 0.0), []
    for k in range(1, len(y)):
        measured = k * dt, k * dt, y[k : k + 1]
        known = own.corrected(
            known, slopes @ known.state, slopes, lambda s: s, lambda s, q, v: np.concatenate([q, v]), measured
        )
        found.append(known.state)
    return np.array(found), known


@pytest.mark.parametrize("index", [1e-3, 0.1, 10.0])
def test_gains_of_a_mass_that_nothing_moves_are_those_of_the_tracking_index(index: float) -> None:
    """Kalata: β²/(1 − α) = λ² with λ = w T²/σ, and β = 2 (2 − α) − 4 √(1 − α)."""
    dt, noise = 0.01, 1e-3
    own = Predicted(dt, ("x",), np.array([index * noise / dt**2]), noise, np.zeros(1), 0.1)
    slopes, y = np.array([[1.0, dt], [0.0, 1.0]]), np.zeros(4000)
    y[-1] = 1.0
    found, _ = filtered(own, slopes, y, dt, np.zeros(2))
    alpha, beta = found[-1] * (1.0, dt)
    assert beta**2 / (1 - alpha) == pytest.approx(index**2, rel=1e-3)
    assert beta == pytest.approx(2 * (2 - alpha) - 4 * np.sqrt(1 - alpha), rel=1e-3)


def test_a_model_and_its_filter_know_rates_better_than_differences() -> None:
    rng, dt, noise, n = np.random.default_rng(3), 0.01, 1e-3, 600
    own = Predicted(dt, ("x",), np.ones(1), noise, np.zeros(1), 0.1)
    time = dt * np.arange(n)
    q, v = np.sin(time), np.cos(time)
    y = q + noise * rng.standard_normal(n)
    # That it accelerates is not in the model.
    found, _ = filtered(own, np.array([[1.0, dt], [0.0, 1.0]]), y, dt, np.array([y[0], 0.0]))
    off, plain = found[200:, 1] - v[201:], np.diff(y)[200:] / dt - v[201:]
    assert np.sqrt((off**2).mean()) < 0.5 * np.sqrt((plain**2).mean())


def test_what_falls_is_not_lost_however_little_is_unexplained() -> None:
    """About a pose that is left as e^(5 t): without its slopes, so small gains would lose it within a second."""
    rng, dt, noise = np.random.default_rng(4), 0.01, 1e-3
    slopes = expm(np.array([[0.0, 1.0], [25.0, 0.0]]) * dt)
    own = Predicted(dt, ("x",), np.full(1, 1e-6), noise, np.zeros(1), 0.1)
    found, known = filtered(own, slopes, noise * rng.standard_normal(500), dt, np.array([noise, 0.0]))
    assert np.abs(found[-100:, 0]).max() < 2 * noise
    assert np.linalg.eigvalsh(known.covariance).min() > 0


def test_slopes_are_those_of_the_motion() -> None:
    way = ExactForward(CARTPOLE, 4, 0.01, compiled=False)
    x, u = np.array([0.1, 0.2, 0.3, -0.4]), np.array([2.0])
    ahead = way(x[None], u[None])[0]
    found = slopes_of(way, x, u, ahead, np.full(4, 1e-6))
    for k in range(4):
        sides = [way((x + side * 1e-4 * (np.arange(4) == k))[None], u[None])[0] for side in (-1, 1)]
        np.testing.assert_allclose(found[:, k], (sides[1] - sides[0]) / 2e-4, atol=1e-5)


def test_a_joint_that_is_not_measured_is_a_fault_after_a_while() -> None:
    plant, own, reference = MujocoPlant(CARTPOLE), SamplingController(FEW), HoldReference(UPRIGHT)
    seen = plant.reset(Start(command=[0.0], position=UPRIGHT))
    state = own.init(plant.spec, seen)
    said = ""
    for _ in range(20):
        command, state = own.step(seen, reference, state)
        seen = replace(plant.step(command), position=np.array([0.0, np.nan]))
        if said := refusal(lambda: own.step(seen, reference, state)) if seen.time > 0.105 else "":  # noqa: B023
            break
    assert said == "hinge was last measured at 0.000 s and it is 0.110 s, expected a number at least every 0.1 s"


# --- runs ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_it_balances_and_gives_the_same_bits() -> None:
    one, two, other = balanced(CARTPOLE), balanced(CARTPOLE), balanced(CARTPOLE, seed=1)
    assert np.array_equal(one.asked, two.asked) and not np.array_equal(one.asked, other.asked)
    assert one.truth is not None and np.abs(one.truth[-10:, 1]).max() < np.radians(1.5)
    assert one.note.startswith("plans are rolled out by the exact equations of motion: it has neither contacts")
    assert set(one.status) == {"sampled"}


@pytest.mark.slow
def test_it_balances_behind_a_dead_time_and_a_lag_that_it_knows() -> None:
    late = Model(CARTPOLE.robot, (TransportDelay("push", 0.025), FirstOrderLag("push", 0.02)))
    done = balanced(late, seconds=1.0)
    assert done.truth is not None and np.abs(done.truth[-20:, 1]).max() < np.radians(2.0)


def test_an_earlier_state_is_not_changed_by_a_step() -> None:
    plant, own, reference = MujocoPlant(CARTPOLE, noise=1e-3), SamplingController(FEW), HoldReference(UPRIGHT)
    seen = plant.reset(Start(command=[0.0], position=[0.0, 0.05]), 1)
    state, trail = own.init(plant.spec, seen), []
    for _ in range(4):
        command, after = own.step(seen, reference, state)
        trail.append((seen, state, np.array(command)))
        seen, state = plant.step(command), after
    for seen, state, command in reversed(trail):
        np.testing.assert_array_equal(own.step(seen, reference, state)[0], command)


def test_a_robot_with_contacts_is_held_in_mujoco() -> None:
    """On the floor it needs no force; 0.15 m up it needs its weight."""
    plant = MujocoPlant(Model(BOUNCER), noise=1e-4)
    own = SamplingController(replace(FEW, samples=16, horizon=0.3))
    done = run(plant, own, HoldReference([0.15]), 1.5, start=Start(command=[0.0], position=[-0.102]))
    assert done.truth is not None and abs(done.truth[-20:].mean() - 0.15) < 0.02
    assert done.command[-20:].mean() == pytest.approx(9.81, rel=0.1)
    assert done.note == "plans are rolled out by the XML in MuJoCo: it has contacts (floor may touch ball)"


def test_what_touches_on_the_way_is_told() -> None:
    plant = MujocoPlant(Model(BOUNCER))
    plant.reset(Start(command=[0.0], position=[0.0]))
    assert plant.touched == ""
    while plant.position[0] > -0.099:  # 0.1 m down in 0.14 s
        plant.step([0.0])
    plant.step([0.0])
    assert plant.touched in {f"floor touches ball at {time:.3g} s" for time in (0.14, 0.145)}
    plant.reset(Start(command=[0.0], position=[0.0]))
    assert plant.touched == ""
    done = workflow.run_scenario(
        Scenario("fall", "", 0.3, HoldReference([0.0]), start=Start(command=[0.0], position=[0.0])),
        lambda observation, reference: np.zeros(1),
        model=Model(BOUNCER),
    )
    assert done.run.note.startswith("floor touches ball at 0.14")
    assert "contacts are in no equations of motion" in done.run.note


def test_a_servo_follows_a_step() -> None:
    done = workflow.run_scenario(
        "step",
        SamplingController(replace(FEW, samples=16, horizon=0.25)),
        model=Model(RIG),
        options={"duration": "1.2", "begins": "0.2"},
    )
    left = done.run.truth[-10:].mean(axis=0) - done.run.reference[-1]
    assert (np.abs(left) < 0.1 * np.abs(done.run.reference[-1] - done.run.reference[0])).all()


def test_where_no_equations_hold_a_robot_it_is_rolled_out_all_the_same() -> None:
    xml = """<mujoco model="wound"><option timestep="0.005"/><worldbody><site name="a" pos="0 0.1 0.2"/>
    <body name="b"><joint name="j" axis="1 0 0" damping="0.2"/><geom name="drum" type="cylinder" size="0.03 0.02"
    euler="0 90 0" contype="0" conaffinity="0"/><geom size="0.02" pos="0 0 -0.2" mass="0.3" contype="0"
    conaffinity="0"/><site name="c" pos="0 0.05 -0.2"/></body></worldbody><tendon><spatial name="t"><site site="a"/>
    <geom geom="drum"/><site site="c"/></spatial></tendon><actuator><motor name="pull" tendon="t" ctrlrange="-20 0"/>
    </actuator></mujoco>"""
    plant = MujocoPlant(Model(MjcfRobot("wound", xml)))
    done = run(plant, SamplingController(replace(FEW, samples=16, horizon=0.3)), HoldReference([0.3]), 1.0)
    assert "no regulator ends them and no energy guides them" in done.note
    assert done.truth is not None and abs(done.truth[-10:].mean() - 0.3) < 0.1


@pytest.mark.slow
def test_a_pole_swings_up_on_its_cart() -> None:
    done = workflow.run_scenario("swing_up", model=CARTPOLE, options={"duration": "7"}, noise=1e-3, seed=3)
    assert done.controller == "sampling" and done.score.arrival is not None
    assert done.score.arrival.arrived and done.score.arrival.time < 6.0


# --- scenario, score, settings ------------------------------------------------------------------------------------


def test_a_robot_has_arrived_once_it_stays() -> None:
    time = np.arange(0, 4, 0.01)
    off = np.column_stack([np.where(time < 1.5, 0.5, 0.01), np.where((time > 1.9) & (time < 2.0), 0.3, 0.0)])
    found = ArrivalFigures.of(time, off, np.array([0.1, 0.1]))
    assert found.time == pytest.approx(2.0, abs=0.011) and found.arrived
    np.testing.assert_allclose(found.left, [0.01, 0.0])
    assert not ArrivalFigures.of(time[:280], off[:280], np.array([0.1, 0.1])).arrived, "0.8 s are not a second"
    assert not ArrivalFigures.of(time, off + 0.2, np.array([0.1, 0.1])).arrived


def test_whole_turns_of_a_hinge_without_end_are_none() -> None:
    scenario = workflow.load_scenario("swing_up", CARTPOLE.robot, search=False)
    assert isinstance(scenario, Scenario) and scenario.controller == "sampling"
    np.testing.assert_allclose(scenario.start.position, [0.0, np.pi])
    plant = MujocoPlant(CARTPOLE)
    start = Start(command=[0.0], position=[0.0, 2 * np.pi])
    still = run(plant, make_controller("open_loop", commands=lambda time: np.zeros(1)), HoldReference(UPRIGHT), 1.2,
                start=start)  # fmt: skip
    score = score_run(still, replace(scenario, duration=1.2))
    assert score.arrival is not None and score.arrival.time == 0.0 and score.tracking.rmse[1] < 0.01


def test_where_it_is_to_go_is_asked_for() -> None:
    def built(robot: MjcfRobot, **options: str) -> Scenario:
        return workflow.load_scenario("swing_up", robot, options=options, search=False)

    bare = MjcfRobot("bare", pendulum())
    assert (
        "bare has no keyframe 'upright' (keyframes: none); name one with keyframe=, or the pose by joints"
        in refusal(lambda: built(bare))
    )
    assert built(bare, pivot="180").reference.position(0.0) == pytest.approx([np.pi])
    assert "hinge cannot be held at 90°" in refusal(lambda: built(CARTPOLE.robot, hinge="90"))
    assert "expected more than 0" in refusal(lambda: built(CARTPOLE.robot, within="0"))


@pytest.mark.parametrize(("model", "begins", "kind"), [
    (CARTPOLE, None, PolicyState), (Model(BOUNCER), [-0.102], PolicyState), (Model(BOUNCER), [0.1], SamplingState),
    (Model(RIG), None, SamplingState), (nominal_model(), None, SamplingState),
], ids=lambda own: getattr(own, "name", ""))  # fmt: skip
def test_one_file_is_for_every_robot_and_what_plans_are_follows_from_it(
    model: Model, begins: list[float] | None, kind: type
) -> None:
    path = presets.find("controllers", "sampling.toml")
    assert path is not None
    table = {**presets.read_toml(path), "compiled": False, "samples": 8}
    assert SamplingSettings.from_dict(presets.read_toml(path)) == SamplingSettings()
    plant = MujocoPlant(model)
    own = make_controller("sampling", table, robot=model.robot, chosen=True)
    seen = plant.reset(Start(position=begins), seed=0)
    pose = HoldReference(seen.position)
    command, state = own.step(seen, pose, own.init(plant.spec, seen))
    assert isinstance(state, kind) and np.isfinite(command).all()
    # What is for plans of the other kind is refused, and left aside in a file that all robots share.
    name, words = ("risk", "robots whose joints") if kind is PolicyState else ("effort", "robots with a joint")
    idle = {name: 0.5}
    other = make_controller("sampling", {**table, **idle}, robot=model.robot, chosen=True)
    assert refusal(lambda: other.init(plant.spec, seen)).startswith(f"sampling: {name} is for {words}")
    shared = make_controller("sampling", {**table, **idle}, where="sampling.toml", robot=model.robot)
    _, state = shared.step(seen, pose, shared.init(plant.spec, seen))
    assert state.note.startswith(f"sampling.toml: {name} left aside")


@pytest.mark.slow
def test_a_robot_that_can_follow_a_path_is_left_no_offset_by_masses_that_nobody_told_of() -> None:
    heavy = Model(RIG, (PayloadMass("rod", 0.3),))
    plant = MujocoPlant(heavy, nominal=Model(RIG))
    own = SamplingController(SamplingSettings(compiled=False))
    pose = RIG.home + np.array([0.4, 0.0])
    done = run(plant, own, HoldReference(pose), 2.5)
    assert done.truth is not None and np.abs(done.truth[-30:].mean(axis=0) - pose).max() < 3e-3


def test_at_rest_nothing_wanders_and_the_regulator_is_followed() -> None:
    own = SamplingController(SamplingSettings(compiled=False))
    done = run(MujocoPlant(Model(RIG)), own, HoldReference(RIG.home), 2.0)
    assert done.truth is not None and np.ptp(done.truth[-30:], axis=0).max() < 1e-6


@pytest.mark.parametrize(
    "given", [{"samples": 2}, {"effort": 0.0}, {"engine": "fast"}, {"method": "luck"}, {"every": 0}]
)
def test_settings_that_are_none_are_refused(given: dict[str, object]) -> None:
    (key,) = given
    assert key in refusal(lambda: SamplingSettings.from_dict(given))


def test_its_state_tells_what_plans_cost() -> None:
    plant, own = MujocoPlant(CARTPOLE), SamplingController(FEW, penalty=lambda times, states, inputs, wanted: 5.0)  # type: ignore[arg-type, return-value]
    seen = plant.reset(Start(command=[0.0], position=UPRIGHT))
    _, state = own.step(seen, HoldReference(UPRIGHT), own.init(plant.spec, seen))
    assert isinstance(state, PolicyState) and state.cost.min() >= 5.0
