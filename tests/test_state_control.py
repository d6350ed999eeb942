"""LQR and NMPC on robots read from XML: hinges, slides, servos and a pole that falls, beside the PID."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mjcf_models import CRANE, RIG, pendulum, refusal
from scipy.linalg import expm

from equimus_ctrl import workflow
from equimus_ctrl.controllers.allowances import Loop, allowances
from equimus_ctrl.controllers.catching import CAUGHT, Falls
from equimus_ctrl.controllers.inverse import Inverse
from equimus_ctrl.controllers.lqr import LqrController, LqrSettings, Schedule, _nearest_corners, regulator
from equimus_ctrl.controllers.nmpc import NmpcController, NmpcSettings
from equimus_ctrl.controllers.placement import DAMPING
from equimus_ctrl.effects import Effect, FirstOrderLag, PayloadMass, TransportDelay
from equimus_ctrl.engines import native
from equimus_ctrl.errors import ControllerError
from equimus_ctrl.estimation.noise_model import followed
from equimus_ctrl.loop import run
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.prediction import prediction, steps_in
from equimus_ctrl.plants.mujoco_plant import MujocoPlant, PlantRates
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.scenarios.references import FunctionReference, HoldReference
from equimus_ctrl.types import Array, Controller, Run, Start

PENDULUM = workflow.load_model(Path(__file__).parents[1] / "docs" / "examples" / "pendulum.xml").robot
CARTPOLE = workflow.load_model(Path(__file__).parents[1] / "docs" / "examples" / "cartpole.xml")
FINGER = workflow.load_model(Path(__file__).parents[1] / "docs" / "examples" / "finger.toml")
ARM = MjcfRobot(
    "two_joints",
    """<mujoco model="two_joints"><compiler angle="radian"/><option timestep="0.002"/><worldbody>
    <body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1" armature="0.02"/>
    <inertial mass="1.2" pos="0.15 0 0" diaginertia="0.001 0.01 0.01"/>
    <body name="fore" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="0.1" armature="0.01"/>
    <inertial mass="0.8" pos="0.1 0 0" diaginertia="0.001 0.006 0.006"/></body></body></worldbody>
    <actuator><motor name="m1" joint="shoulder" ctrlrange="-20 20"/><motor name="m2" joint="elbow" ctrlrange="-8 8"/>
    </actuator></mujoco>""",
)
SERVO = MjcfRobot(
    "servo",
    pendulum('damping="0.6" frictionloss="0.05"', drive='<position name="goal" joint="pivot" kp="60" kv="1"/>'),
)
UPRIGHT = MjcfRobot(
    "upright",
    """<mujoco model="upright"><compiler angle="radian"/><option timestep="0.005"/><worldbody><body name="cart">
    <joint name="slider" type="slide" axis="1 0 0" range="-1 1" limited="true" damping="0.5"/>
    <inertial mass="1" pos="0 0 0" diaginertia="0.01 0.01 0.01"/>
    <body name="pole"><joint name="hinge" axis="0 1 0" damping="0.01"/>
    <inertial mass="0.2" pos="0 0 0.3" diaginertia="0.006 0.006 0.0001"/></body></body></worldbody>
    <actuator><motor name="push" joint="slider" ctrlrange="-20 20"/></actuator></mujoco>""",
)
every_robot = pytest.mark.parametrize("robot", [PENDULUM, ARM, SERVO, RIG], ids=lambda robot: robot.name)
DT = 0.008


# --- the model that is computed with ------------------------------------------------------------------------------


def started(robot: MjcfRobot, effects: tuple[Effect, ...] = ()) -> tuple[Model, Array, Array]:
    """A model, and a state and a command somewhere."""
    model, rng = Model(robot, effects), np.random.default_rng(3)
    own = prediction(model, stops=False)
    u = 0.3 * rng.normal(size=own.na)
    x = np.concatenate(
        [0.2 * rng.normal(size=own.nj), rng.normal(size=own.nj), u, np.zeros(own.nx - 2 * own.nj - own.na)]
    )
    return model, x, u


@pytest.mark.parametrize("robot", [PENDULUM, ARM, RIG, CRANE], ids=lambda robot: robot.name)
def test_a_step_comes_to_what_mujoco_does(robot: MjcfRobot) -> None:
    model, x, u = started(robot)
    own, joints = prediction(model, stops=False), len(robot.joint_names)
    plant = MujocoPlant(model, rates=PlantRates(100, 100, 10_000))
    plant.reset(Start(command=u, position=x[:joints], velocity=x[joints : 2 * joints]))
    seen = plant.step(u)
    after = np.array(own.step(x, u, np.zeros(joints), 0.01)).ravel()
    np.testing.assert_allclose(after[:joints], seen.position, atol=5e-5)
    assert np.abs(seen.position - x[:joints]).max() > 3e-3


@pytest.mark.parametrize("robot", [ARM, RIG], ids=lambda robot: robot.name)
def test_a_step_is_of_second_order_and_knows_its_derivatives(robot: MjcfRobot) -> None:
    model, x, u = started(robot, (FirstOrderLag(robot.actuator_names[0], 0.03),))
    own = prediction(model, stops=False)
    nj, d = own.nj, 0.1 * np.ones(own.nj)
    x[nj : 2 * nj] += 2.0  # where dry friction slides

    def after(h: float, steps: int) -> Array:
        state = x
        for _ in range(steps):
            state = np.array(own.step(state, u + 0.5, d, h / steps)).ravel()
        return state

    exact = after(0.02, 64)
    coarse, fine = (np.abs(after(0.02, steps) - exact).max() for steps in (1, 2))
    assert 3.0 < coarse / fine < 5.5
    found = [np.array(part) for part in own.slopes(x, u, d, 1e-3)]
    for k, (slope, size) in enumerate(zip(found[1:], (own.nx, own.na, nj), strict=True)):
        for i in range(size):
            sides = []
            for side in (-1e-6, 1e-6):
                given = [x.copy(), u.copy(), d.copy()]
                given[k][i] += side
                sides.append(np.array(own.step(*given, 1e-3)).ravel())
            np.testing.assert_allclose(slope[:, i], (sides[1] - sides[0]) / 2e-6, atol=1e-4)


@pytest.mark.parametrize(("damping", "stiffness"), [(0.02, 5000), (0.5, 5000), (20, 5000), (0.02, 5)])
def test_what_oscillates_fast_is_followed_by_as_many_steps_as_that_takes(damping: float, stiffness: float) -> None:
    model = Model(MjcfRobot("mode", pendulum(f'damping="{damping}" stiffness="{stiffness}"')))
    own, dynamics = prediction(model, stops=False), Dynamics(model)
    steps, a = steps_in(model, 0.016), dynamics.linear(np.zeros(1)).matrices()[0]
    whole = np.eye(2)
    for _ in range(steps):
        slopes = own.slopes(own.at_rest(np.zeros(1), np.zeros(1)), np.zeros(1), np.zeros(1), 0.016 / steps)
        whole = np.array(slopes[1])[:2, :2] @ whole
    assert np.abs(np.linalg.eigvals(whole) - np.linalg.eigvals(expm(a * 0.016))).max() < 0.06
    assert (steps > 3) == (damping < 1 and stiffness > 1000)


def test_a_stiff_servo_is_stepped_as_it_moves() -> None:
    stiff = MjcfRobot("stiff", pendulum(drive='<position name="goal" joint="pivot" kp="2000" kv="400"/>'))
    own = prediction(Model(stiff), stops=False)
    x, u = np.array([0.1, 0.0, 0.3]), np.array([0.3])
    for _ in range(500):
        x = np.array(own.step(x, u, np.zeros(1), 0.01)).ravel()
    # Gravity takes the servo m g l sin q / kp aside.
    assert x[0] == pytest.approx(0.3 - 9.81 * 0.3 * np.sin(0.3) / 2000, abs=1e-4)
    assert abs(x[1]) < 1e-6


def test_joints_in_another_order_than_the_equations_are_told_apart() -> None:
    model, x, u = started(ARM)
    own = prediction(model, stops=False)
    pushed = [np.array(own.step(x, u, push, DT)).ravel() - np.array(own.step(x, u, np.zeros(2), DT)).ravel()
              for push in np.eye(2)]  # fmt: skip
    inverse = np.linalg.inv(Dynamics(model).mass(x[:2]))
    np.testing.assert_allclose(np.column_stack(pushed)[2:4] / DT, inverse, rtol=0.05)


# --- weights ------------------------------------------------------------------------------------------------------


def test_a_joint_of_its_own_gets_the_poles_that_the_bandwidth_says() -> None:
    free = MjcfRobot("free", pendulum(option='<flag gravity="disable"/>'))
    plant = MujocoPlant(Model(free))
    allowed = allowances(plant.spec, LqrSettings(bandwidth=0.5), np.zeros(1))
    found = regulator(Model(free), np.zeros(1), LqrSettings(), 1e-3, allowed)
    poles = np.log(np.linalg.eigvals(found.a - found.b @ found.gain)) / 1e-3
    omega = 2 * np.pi * 0.5
    np.testing.assert_allclose(np.abs(poles), omega, rtol=0.01)
    np.testing.assert_allclose(-poles.real / np.abs(poles), DAMPING, rtol=0.01)


def test_what_is_late_makes_it_slower_and_is_borne_when_it_is_not_known() -> None:
    found = []
    for delay in (0.0, 0.03, 0.1):
        model = Model(ARM, tuple(TransportDelay(name, delay) for name in ARM.actuator_names) if delay else ())
        spec = MujocoPlant(model).spec
        own = allowances(spec, LqrSettings(), ARM.home)
        loop = Loop(Dynamics(model).linear(ARM.home), Dynamics(model), model, spec.control_dt)
        assert own.late and loop.growth(own, loop.unknown, 1.0) < 1
        assert loop.growth(own, loop.unknown + 40, 1.0) > 1
        found.append(own.bandwidth)
    assert found[0] > 1.3 * found[1] > 1.5 * found[2]
    assert "for a bandwidth of" in own.note


STIFF = MjcfRobot("stiff", pendulum('damping="0.02" stiffness="5000"'))
"""A mode of 35 Hz that hardly anything damps, some 1.8 rad a control period."""


@pytest.mark.slow
def test_where_less_delay_is_worse_than_more_all_of_it_is_looked_at() -> None:
    plant, dynamics = MujocoPlant(Model(STIFF)), Dynamics(Model(STIFF))
    loop = Loop(dynamics.linear(np.zeros(1)), dynamics, Model(STIFF), plant.spec.control_dt)
    quick = allowances(plant.spec, LqrSettings(bandwidth=3.0), np.zeros(1))
    growth = [loop.growth(quick, late, 1.0) for late in range(loop.unknown + 1)]
    assert growth[0] < 1 and max(growth) > 1.01 > growth[-1]
    own = allowances(plant.spec, LqrSettings(), np.zeros(1))
    assert own.late and not own.dies
    assert max(loop.growth(own, late, 1.0) for late in range(loop.unknown + 1)) <= 1 + 1e-9


def test_a_bandwidth_that_was_set_is_judged() -> None:
    spec = MujocoPlant(Model(STIFF)).spec
    note = allowances(spec, LqrSettings(bandwidth=3.0), np.zeros(1)).note
    assert "3 Hz that was set" in note and "not where commands are later than is known" in note


def test_what_arrives_strays_by_shares_of_what_is_allowed_whatever_positions_are_measured_in() -> None:
    one, other = (followed(np.ones(1), np.full(1, 3.0), 4.0, noise, DT) for noise in (2e-3, 2.0))
    np.testing.assert_array_equal(one.pressure, other.pressure)


def test_the_loop_that_is_judged_is_the_one_that_runs() -> None:
    """What is left of a small error after a while, in the plant and by the largest eigenvalue."""
    still = MjcfRobot("still", pendulum('damping="0.2"'))
    plant = MujocoPlant(Model(still))
    own = allowances(plant.spec, LqrSettings(bandwidth=1.0), np.zeros(1))
    dynamics = Dynamics(Model(still))
    loop = Loop(dynamics.linear(np.zeros(1)), dynamics, Model(still), plant.spec.control_dt)
    settings = LqrSettings(bandwidth=1.0, start_time=0.0)
    done = run(plant, LqrController(settings), HoldReference([0.0]), 3.0, start=Start(position=np.array([0.01])))
    left = np.abs(done.position[:, 0]).reshape(-1)
    envelope = [left[k : k + 40].max() for k in (80, 160)]
    assert envelope[1] / envelope[0] < 1.5 * loop.growth(own, 0, 1.0) ** 80


def test_gains_between_many_poses_are_in_between() -> None:
    rng = np.random.default_rng(0)
    slope = rng.normal(size=4)
    for _ in range(10):
        place = 3 * rng.normal(size=4)
        below = np.floor(place).astype(int)
        sides = [((int(k), 1 - (x - k)), (int(k) + 1, x - k)) for k, x in zip(below, place, strict=True)]
        corners = list(_nearest_corners(sides))
        assert sum(share for _, share in corners) == pytest.approx(1.0)
        assert min(share for _, share in corners) >= 0
        assert sum(share * (slope @ corner) for corner, share in corners) == pytest.approx(slope @ place)
    schedule = Schedule(Model(ARM), LqrSettings(), DT)
    turn = np.array([0.0, 2 * np.pi])  # joints without ends go on
    np.testing.assert_allclose(
        schedule.gain(np.array([0.1, 0.5]) + turn), schedule.gain(np.array([0.1, 0.5])), rtol=0.03
    )


# --- what it does -------------------------------------------------------------------------------------------------


def nmpc(**options: float) -> NmpcController:
    """Without a C compiler: nothing has to be compiled here."""
    return NmpcController(NmpcSettings(compiled=False, **options))  # type: ignore[arg-type]


def tracked(robot: MjcfRobot, controller: str | Controller, *effects: Effect) -> float:
    """RMSE of the true positions on the standard path with noise [rad or m]."""
    done = workflow.run_scenario(
        "track", controller, model=Model(robot), effects=effects, noise=1e-3, options={"leg_time": "0.6"}
    )
    own, (begin, end) = done.run, done.score.window
    assert own.truth is not None
    inside = (own.time >= begin) & (own.time <= end)
    return float(np.sqrt(((own.truth - own.reference)[inside] ** 2).mean()))


@pytest.mark.slow
@every_robot
def test_it_follows_a_path_about_as_well_as_the_pid(robot: MjcfRobot) -> None:
    assert tracked(robot, "lqr") < max(1.2 * tracked(robot, "pid"), 1e-3)
    heavy = PayloadMass(robot.places()["link"][-1], 0.2)
    pid = tracked(robot, "pid", heavy)
    assert tracked(robot, "lqr", heavy) < 1.8 * pid
    assert tracked(robot, nmpc(), heavy) < 1.8 * pid


@pytest.mark.slow
def test_a_lag_that_is_known_costs_little() -> None:
    drive = '<general name="m" joint="pivot" dyntype="filter" dynprm="0.1" gainprm="2"/>'
    slow = MjcfRobot("slow", pendulum('damping="0.3"', drive=drive))
    heavy = PayloadMass("arm", 0.2)
    assert tracked(slow, "lqr", heavy) < 0.2 * tracked(slow, "pid", heavy)
    assert tracked(slow, nmpc(), heavy) < 0.2 * tracked(slow, "pid", heavy)


@pytest.mark.slow
@pytest.mark.parametrize("robot", [ARM, SERVO], ids=lambda robot: robot.name)
def test_a_delay_that_nobody_told_of_is_borne(robot: MjcfRobot) -> None:
    late = tuple(TransportDelay(name, 0.02) for name in robot.actuator_names)
    assert tracked(robot, "lqr", *late) < 1.6 * tracked(robot, "pid", *late)


@pytest.mark.slow
@pytest.mark.parametrize("robot", [ARM, SERVO, RIG], ids=lambda robot: robot.name)
def test_a_load_that_nobody_told_of_leaves_no_offset(robot: MjcfRobot) -> None:
    heavy, pose = (PayloadMass(robot.places()["link"][-1], 0.2),), {robot.joint_names[0]: "30", "duration": "4"}
    for disturbance in (True, False):
        settings = LqrSettings(disturbance=disturbance)
        done = workflow.run_scenario("hold", LqrController(settings), model=Model(robot), effects=heavy, options=pose)
        off = np.abs(done.run.position[-50:] - done.run.reference[-50:]).max()
        assert (off < 1e-3) == disturbance


def upright(controller: Controller, noise: float = 0.0, position: tuple[float, float] = (0.0, 0.1)) -> Run:
    plant = MujocoPlant(Model(UPRIGHT), noise=noise)
    return run(plant, controller, HoldReference([0.0, 0.0]), 5.0, start=Start(position=np.array(position)), seed=1)


@pytest.mark.slow
def test_a_pole_that_falls_is_held_where_no_pid_of_the_cart_does() -> None:
    said = refusal(lambda: workflow.run_scenario("hold", "pid", model=Model(UPRIGHT)))
    assert "hinge moves away from 0°" in said
    for controller in (LqrController(), nmpc()):
        for begins in ((0.0, 0.1), (0.3, 0.0)):  # a cart that is aside has to go further aside first
            assert np.abs(upright(controller, position=begins).position[-100:]).max() < 1e-4
        assert np.abs(upright(controller, 1e-3).position[-200:]).max() < 0.02


@pytest.mark.slow
def test_a_plan_catches_a_pole_that_the_regulator_lets_fall() -> None:
    """The force that the regulator asks for is beyond the limit; the plan knows that."""
    assert np.abs(upright(LqrController(), position=(0.0, 0.8)).position[-100:]).max() > 0.5
    done = upright(nmpc(), position=(0.0, 0.8))
    assert np.abs(done.position[-100:]).max() < 0.02
    assert np.abs(done.position[:, 0]).max() < 1.01 and np.abs(done.asked).max() <= 20.0


def test_what_falls_is_caught_from_a_share_of_where_limits_let_anything_catch_it() -> None:
    """Of θ̈ = 4 θ + 2 u with |u| ≤ 3 a departure at rest grows whatever is done beyond 2·3/4."""
    a, b = np.array([[0.0, 1.0], [4.0, 0.0]]), np.array([[0.0], [2.0]])
    reach = np.array([[-3.0], [3.0]])
    found = Falls.of(a, b, 1, np.array([10.0]), reach)
    assert found is not None
    np.testing.assert_allclose(found.first, [[1.5 * CAUGHT, -1.5 * CAUGHT], [0.0, 0.0]])
    near = Falls.of(a, b, 1, np.array([0.3]), reach)
    assert near is not None and near.first[0, 0] == pytest.approx(0.3 * CAUGHT)
    assert Falls.of(np.array([[0.0, 1.0], [-4.0, 0.0]]), b, 1, np.array([10.0]), reach) is None, "nothing falls"
    assert Falls.of(a, b, 1, np.array([10.0]), np.inf * reach) is None, "nothing limits it"


@pytest.mark.slow
def test_limits_make_a_regulator_of_what_falls_slower_so_that_it_catches_it() -> None:
    """Where a pole on a cart begins a third of the way to where 10 N are too little, and a fixed bandwidth lets it fall."""
    plant = MujocoPlant(CARTPOLE, noise=1e-3)
    quick, own = (allowances(plant.spec, LqrSettings(), np.zeros(2), bounded) for bounded in (False, True))
    assert own.catches and 0.4 * quick.bandwidth < own.bandwidth < 0.7 * quick.bandwidth
    # A pole that leans by more than a/g cannot be caught by a cart that accelerates by a, and 10 N push 1.1 kg.
    start = Start(position=np.array([0.0, CAUGHT * 10 / (1.1 * 9.81)]))
    for settings, caught in ((LqrSettings(), True), (LqrSettings(bandwidth=quick.bandwidth / (2 * np.pi)), False)):
        done = run(plant, LqrController(settings), HoldReference([0.0, 0.0]), 5.0, start=start, seed=1)
        assert done.truth is not None
        assert bool(np.abs(done.truth[-50:]).max() < 0.02) == caught
        assert ("limits of commands let it catch less" in done.note) == (not caught)


@pytest.mark.parametrize("robot", [RIG, SERVO], ids=lambda robot: robot.name)
def test_where_nothing_is_in_the_way_the_plan_is_the_regulators(robot: MjcfRobot) -> None:
    asked = []
    wanted = HoldReference(robot.home + 2e-4)
    for controller in (LqrController(), nmpc(stride=1, nodes=20, tolerance=1e-6)):
        done = run(MujocoPlant(Model(robot)), controller, wanted, 0.4, start=Start(position=robot.home))
        asked.append(done.command - done.command[0])
    assert np.abs(asked[0]).max() > 1e-4
    np.testing.assert_allclose(asked[1], asked[0], atol=0.03 * np.abs(asked[0]).max())


@pytest.mark.slow
def test_ranges_and_velocities_are_bounded() -> None:
    narrow = MjcfRobot("narrow", pendulum('damping="0.1" range="-1 0.5" limited="true"'))
    plant = MujocoPlant(Model(narrow))
    beyond = FunctionReference(lambda t: np.array([0.45 - 0.25 * np.cos(np.pi * np.clip(t, 0, 1))]))
    most = []
    for controller in (LqrController(), nmpc(start_time=0.0)):
        done = run(plant, controller, beyond, 3.0, start=Start(position=np.array([0.2])))
        assert done.position[-50:].min() > 0.49
        most.append(np.abs(done.command).max())
    assert done.position.max() < 0.51
    assert most[1] < 0.5 * most[0]  # the regulator presses on the end
    free = MujocoPlant(Model(PENDULUM))
    quick = FunctionReference(lambda t: np.array([0.5 - 0.5 * np.cos(np.pi * np.clip(2 * t - 1, 0, 1))]))
    fastest = []
    for velocity in (0.0, 2.0):
        done = run(free, nmpc(velocity=velocity), quick, 3.0)
        fastest.append(np.abs(np.diff(done.position[:, 0])).max() / free.spec.control_dt)
        assert done.position[-1, 0] == pytest.approx(1.0, abs=0.01)
    assert fastest[0] > 3.0 and fastest[1] < 2.1


@pytest.mark.slow
def test_machine_code_gives_the_same_plans() -> None:
    found = []
    for compiled in (False, True):
        controller = NmpcController(NmpcSettings(compiled=compiled))
        plant = MujocoPlant(Model(ARM), noise=1e-3)
        state = controller.init(plant.spec, plant.reset(seed=0))
        assert state.tools.problem.is_native == (compiled and native.compiler() is not None)
        found.append(run(plant, controller, HoldReference([0.3, -0.2]), 1.0, seed=0).command)
    np.testing.assert_array_equal(found[0], found[1])


def test_a_step_is_toned_down_when_any_actuator_is_fed_its_motion() -> None:
    inverse = Inverse(Model(ARM, (TransportDelay("m1", 0.06),)), DT, 0.0)
    step = FunctionReference(lambda t: np.array([0.0, 0.0 if t < 0.5 else 0.6]))
    possible: tuple[float, ...] = ()
    state, moved = inverse.start(0.0, np.zeros(2)), 0
    for time in 0.4 + DT * np.arange(20):
        target, after = inverse.target(step, time, state)
        possible = inverse.possible(step, time, state, possible)
        own = inverse.toned(target, min(possible), step, time, state)
        state = after
        beyond = np.abs(target.feed) > 25.0  # more than it takes to hold any pose
        moved += int(beyond.any())
        assert not beyond.any() or np.abs(own.feed).max() < 0.7 * np.abs(target.feed).max()
    assert moved > 5


@pytest.mark.parametrize("robot", [FINGER.robot, ARM], ids=lambda robot: robot.name)
def test_of_a_step_as_much_is_fed_forward_as_can_be_braked(robot: Robot) -> None:
    """What the ends of commands cut off of braking alone would be left over as speed."""
    for controller in (LqrController(), nmpc()):
        done = workflow.run_scenario("step", controller, model=Model(robot), options={"duration": "2"})
        assert done.score.step is not None
        assert np.nanmax(done.score.step.overshoot) < 0.05 and np.abs(done.score.step.offset).max() < 2e-3


def test_commands_stay_within_limits_and_nothing_winds_up() -> None:
    weak = MjcfRobot("weak", pendulum('damping="0.4"', drive='<motor name="motor" joint="pivot" ctrlrange="-2 2"/>'))
    plant = MujocoPlant(Model(weak))
    reference = FunctionReference(lambda t: np.array([1.4 if t < 4 else 0.2]))
    done = run(plant, LqrController(), reference, 7.0)
    assert np.abs(done.asked).max() <= 2.0
    after = done.time > 4.0
    assert np.abs(done.position[after][200:] - 0.2).max() < 0.02
    assert done.position[after].min() > 0.0


def test_a_servos_command_is_a_goal_and_force_limits_are_known() -> None:
    drive = '<position name="goal" joint="pivot" kp="60" kv="1" ctrlrange="-1 1" forcerange="-2.2 2.2"/>'
    robot = MjcfRobot("limited", pendulum('damping="0.6"', drive=drive))
    done = workflow.run_scenario("hold", "lqr", model=Model(robot), options={"pivot": "35", "duration": "3"})
    assert done.score.step is not None and np.abs(done.score.step.offset).max() < 1e-3
    assert np.abs(done.run.asked).max() <= 1.0


@pytest.mark.slow
def test_commands_change_no_faster_than_an_actuator_can() -> None:
    drive = '<pid name="goal" joint="pivot" kp="40" slewmax="0.5" input="pos"/>'
    plant = MujocoPlant(Model(MjcfRobot("slow", pendulum('damping="2"', drive=drive))))
    step = FunctionReference(lambda t: np.array([0.0 if t < 0.5 else 0.6]))
    for controller in (LqrController(), nmpc()):
        done = run(plant, controller, step, 8.0)
        assert np.abs(done.position[-50:] - 0.6).max() < 0.01
    assert np.abs(np.diff(done.command, axis=0)).max() < 1.001 * 0.5 * plant.spec.control_dt


def test_what_keeps_it_from_a_robot_is_told() -> None:
    integrating = MjcfRobot(
        "integrating", pendulum(drive='<intvelocity name="v" joint="pivot" kp="5" actrange="-1 1"/>')
    )
    said = refusal(lambda: workflow.run_scenario("hold", "lqr", model=Model(integrating)))
    assert "lqr computes with exact equations of motion, which cannot hold the integrating actuator 'v'" in said
    idle = MjcfRobot("idle", pendulum(drive='<damper name="brake" joint="pivot" kv="5" ctrlrange="0 2"/>'))
    with pytest.raises(ControllerError, match="idle: no command exerts anything on a joint at rest"):
        workflow.run_scenario("hold", "lqr", model=Model(idle))
    aside = """<body name="aside" pos="2 0 0"><joint name="loose" axis="0 1 0"/>
      <inertial mass="1" pos="0 0 0.3" diaginertia="0.01 0.01 0.01"/></body>"""
    falling = MjcfRobot("falling", pendulum().replace("</worldbody>", aside + "</worldbody>"))
    said = refusal(lambda: workflow.run_scenario("hold", "lqr", model=Model(falling)))
    assert "keeps loose at 0°, where it begins, for it has no actuator, and pivot cannot hold it" in said
    controller = LqrController(LqrSettings(bandwidth=1.0))
    said = refusal(lambda: workflow.run_scenario("hold", controller, model=Model(falling)))
    assert "falling: with bandwidth 1 Hz the loop is unstable where the robot begins" in said


@pytest.mark.parametrize("robot", [ARM], ids=lambda robot: robot.name)
def test_the_exact_derivatives_are_those_of_the_linear_robot(robot: MjcfRobot) -> None:
    own, linear = prediction(Model(robot), stops=False), Dynamics(Model(robot)).linear(robot.home)
    a, b = linear.matrices()
    whole = np.zeros((6, 6))
    whole[:4, :4], whole[:4, 4:] = a, b
    held, _ = Dynamics(Model(robot)).holding(robot.home)
    _, by_x, by_u, _ = (np.array(part) for part in own.slopes(own.at_rest(robot.home, held), held, np.zeros(2), 1e-3))
    np.testing.assert_allclose(by_x[:4, :4], expm(whole * 1e-3)[:4, :4], atol=1e-6)
    np.testing.assert_allclose(by_u[:4], expm(whole * 1e-3)[:4, 4:], atol=1e-5)
