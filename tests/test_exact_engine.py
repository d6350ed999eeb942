"""Compiled equations of motion of MuJoCo models: MuJoCo's own laws, without its step."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import mujoco
import numpy as np
import pytest
from mjcf_models import CRANE, RIG, pendulum, swinging

from equimus_ctrl.effects import (
    CoulombFriction,
    DirectionalLoadFriction,
    DriveCompliance,
    Effect,
    PayloadMass,
    PlaneContact,
    PositionDependentFriction,
    SpringTether,
    TetherWithFreeLength,
    TorqueRipple,
    ViscousFriction,
)
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.choice import MujocoEngine, ReducedEngine, engine_for
from equimus_ctrl.engines.encoding import encode
from equimus_ctrl.engines.field import Field
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.motion import motion
from equimus_ctrl.engines.step_choice import noise_of
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.parts import constrained, gaps, grips
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.models.symbolic_model import ldl_solve
from equimus_ctrl.robots.mjcf.obstacles import obstacles
from equimus_ctrl.robots.mjcf.packing import pack
from equimus_ctrl.robots.mjcf.reading import form_of
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array
from equimus_ctrl.validation.random_trees import ALL, controls, converged, random_tree

SMOOTH = [feature for feature in ALL if "friction" not in feature]


@cache
def tree(seed: int, joints: int) -> str:
    return random_tree(np.random.default_rng(seed), joints, SMOOTH)


# --- accelerations ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(14))
def test_accelerations_are_mujocos(seed: int) -> None:
    """At random states of random trees with all that the equations hold; in the limit of a step of nothing."""
    m = mujoco.MjModel.from_xml_string(tree(seed, 1 + seed % 7))
    if what := obstacles(m):
        assert all("whose goal may be any of many turns" in phrase for phrase in what)
        pytest.skip(what[0])
    m.opt.tolerance, m.opt.iterations, m.opt.timestep = 0.0, 300, 1e-9
    m.actuator_actearly[:], m.actuator_delay[:] = 0, 0.0
    form, numbers = form_of(m), pack(form_of(m), m)
    data, rng = mujoco.MjData(m), np.random.default_rng(seed)
    found = accelerations(form)
    for _ in range(20):
        data.qpos[:] = m.qpos0 + 0.5 * rng.normal(size=m.nq)
        data.qvel[:], data.ctrl[:], data.act[:] = rng.normal(size=m.nv), rng.normal(size=m.nu), rng.normal(size=m.na)
        commands, inside = np.array(data.ctrl), []
        for a in form.actuators:
            first = int(m.actuator_actadr[a.index])
            if a.dynamics == "slew":
                low, high = m.actuator_ctrlrange[a.control] if m.actuator_ctrllimited[a.control] else (-9.0, 9.0)
                commands[a.control] = data.act[first] = np.clip(commands[a.control], low, high)
                first += 1
            elif a.dynamics != "none":
                commands[a.control] = data.act[first]
            inside += list(data.act[first : first + len(a.states)])
        mujoco.mj_forward(m, data)
        pressed = np.zeros(form_limits(form))
        for _ in range(10):
            own, asked = (
                np.array(part).ravel() for part in found(data.qpos, data.qvel, commands, inside, pressed, numbers)
            )
            if np.array_equal(pressed, asked > 0):
                break
            pressed = (asked > 0) * 1.0
        np.testing.assert_allclose(own, data.qacc, rtol=0, atol=1e-10 * max(np.abs(data.qacc).max(), 1.0))


def form_limits(form: Any) -> int:
    return len(build(form, "swing").limits)


def accelerations(form: Any) -> ca.Function:
    """(q, v, commands, own states, pressed limits, numbers) → accelerations, and which limits ask to be pressed."""
    m = build(form, "swing")
    pressed = ca.SX.sym("pressed", len(m.limits))
    load = m.actuation.torque(m.u) - m.smooth_bias
    a = ldl_solve(*constrained(m.mass, load, m.held, m.limits, *grips(m.limits, pressed)))
    return ca.Function("a", [m.q, m.v, m.u, m.inside.state, pressed, m.p], [a, gaps(m.limits, a)])


# --- motion -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_motion_of_a_random_tree_is_what_mujocos_tend_to() -> None:
    text, rng = tree(16, 3), np.random.default_rng(16)
    model = mujoco.MjModel.from_xml_string(text)
    times, commands = controls(rng, model, 2.0)
    exact = converged(text, times, commands, 2.0)
    robot = MjcfRobot("tree", text)
    # MuJoCo's activations begin with nothing.
    none = np.zeros(model.nu)
    trial = Trial("t", times, commands, none, 0.0, np.array(model.qpos0), exact.times, activation=none)
    found = simulate([Model(robot)], [trial], dt=2.5e-4, check=False)[0]
    assert found.sound.all()
    np.testing.assert_allclose(found.position[0], exact.q, rtol=0, atol=2e-6)


@pytest.mark.slow
def test_what_sticks_stands_still_and_what_slides_is_mujocos() -> None:
    robot, trial = CRANE, Trial(
        "t", np.array([0.0, 0.5, 1.0]), np.array([[3.0, 0.4, 0.1], [-3.0, -0.4, 0.0], [0.0, 0.0, 0.0]]), np.zeros(3), 0.0,
        np.array([0.3, 0.02]), np.linspace(0.0, 2.0, 101),
    )  # fmt: skip
    found = simulate([Model(robot)], [trial], dt=2.5e-4, check=False)[0].position[0]
    model = robot.mujoco_model(2e-5)
    model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_RK4)
    model.dof_solref[:], model.dof_solimp[:, :2] = (-1.0, -1 / model.opt.timestep), 0.9999
    data, expected = mujoco.MjData(model), []
    data.qpos[:] = trial.position
    for _ in range(101):
        expected.append(np.array(data.qpos))
        for _step in range(1000):
            data.ctrl[:] = trial.commands[np.searchsorted(trial.times, data.time + 1e-9, side="right") - 1]
            mujoco.mj_step(model, data)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)


@pytest.mark.slow
def test_a_drive_that_gives_way_is_mujocos_without_its_step() -> None:
    """MuJoCo's error of first order is taken off by two steps (Richardson, 1911)."""
    model = Model(RIG, (DriveCompliance("shoulder", 60.0, 0.4),))
    trial = swinging()
    own = simulate([model], [trial], dt=1e-3, check=False)[0].position[0]
    half, whole = (simulate_mjcf([model], [trial], dt=dt)[0].position[0] for dt in (2.5e-5, 5e-5))
    np.testing.assert_allclose(own, 2 * half - whole, rtol=0, atol=5e-6)
    rigid = simulate([Model(RIG)], [trial], dt=1e-3, check=False)[0].position[0]
    assert np.abs(own - rigid).max() > 0.01


@pytest.mark.parametrize(
    "effects",
    [
        (),
        (PayloadMass("tip", 0.3),),
        (ViscousFriction("shoulder", 0.4),),
        (CoulombFriction("reach", 2.0),),
        (SpringTether("tip", 20.0, 0.4, 0.2, -0.3),),
        (TetherWithFreeLength("tip", 20.0, 0.4, 0.2, -0.3, 0.25),),
        (TorqueRipple("shoulder", 0.8, -0.5, 0.4),),
        (PositionDependentFriction("shoulder", 0.1, 0.8, 0.5),),
        (DirectionalLoadFriction("reach", 0.1, 0.4),),
    ],
    ids=lambda effects: effects[0].name if effects else "none",
)
def test_effects_are_the_same_in_both_engines(effects: tuple[Effect, ...]) -> None:
    model, trial = Model(RIG, effects), swinging(1)
    own = simulate([model], [trial], dt=5e-4, check=False)[0].position[0]
    half, whole = (simulate_mjcf([model], [trial], dt=dt)[0].position[0] for dt in (1e-5, 2e-5))
    np.testing.assert_allclose(own, 2 * half - whole, rtol=0, atol=2e-5)


def test_what_hits_a_surface_is_the_same_in_both_engines() -> None:
    """MuJoCo's error jumps with the step in which it is hit, so that two steps do not take it off."""
    model, trial = Model(RIG, (PlaneContact("tip", -0.58),)), swinging(1)
    own = simulate([model], [trial], dt=5e-4, check=False)[0].position[0]
    np.testing.assert_allclose(own, simulate_mjcf([model], [trial], dt=5e-6)[0].position[0], rtol=0, atol=5e-5)
    assert np.abs(own - simulate([Model(RIG)], [trial], dt=5e-4, check=False)[0].position[0]).max() > 0.01


def test_energy_is_kept_where_nothing_takes_it() -> None:
    robot = MjcfRobot("p", pendulum('stiffness="2"'))
    samples = np.linspace(0.0, 5.0, 501)
    trial = Trial("t", np.zeros(1), np.zeros((1, 1)), np.zeros(1), 0.0, np.array([1.0]), samples)
    q = simulate([Model(robot)], [trial], dt=1e-3, check=False)[0].position[0, :, 0]
    v = np.gradient(q, samples, edge_order=2)
    inertia = 0.02 + 0.01 + 1.0 * 0.3**2
    energy = inertia * v**2 / 2 + 9.81 * 0.3 * (1 - np.cos(q)) + 2.0 * q**2 / 2
    np.testing.assert_allclose(energy[2:-2], energy[2], rtol=2e-3)


@pytest.mark.slow
def test_a_spatial_arm_keeps_its_energy_and_its_momentum_about_a_vertical_first_joint() -> None:
    """Without friction; gravity has no torque about the first joint's axis."""
    robot = MjcfRobot("chain", chain(4).replace('<joint name="j0" axis="1 0.2 0"/>', '<joint name="j0" axis="0 0 1"/>'))
    model, mechanics = Model(robot), robot.mechanics()
    samples = np.linspace(0.0, 5.0, 201)
    rest, start = np.zeros((1, 1)), np.array([0.3, 0.8, -0.5, 0.4, 2.0, -1.0, 1.5, 0.7])
    moved = motion(model, Trial("t", np.zeros(1), rest, rest[0], 0.0, start[:4], samples), start, dt=1e-3)
    own = build(mechanics.form, "swing")
    both = ca.Function("kept", [own.q, own.v, own.p], [own.kinetic + own.potential, (own.mass @ own.v)[0], own.kinetic])
    energy, momentum, kinetic = both.map(len(samples))(moved.coordinates.T, moved.rates.T, mechanics.parameters)
    assert np.ptp(np.array(kinetic)) > 0.5  # it is exchanged all the time
    np.testing.assert_allclose(np.array(energy).ravel(), float(energy[0]), rtol=0, atol=1e-7)
    np.testing.assert_allclose(np.array(momentum).ravel(), float(momentum[0]), rtol=0, atol=1e-8)


def test_slopes_are_those_of_a_pendulum() -> None:
    robot = MjcfRobot("p", pendulum('damping="0.1"'))
    coded = encode([Model(robot)])
    field = Field.of(coded)
    angles = np.array([[0.0], [0.5], [2.0]])
    slopes = field.slopes(field.states(angles, np.zeros_like(angles)))
    inertia = 0.02 + 0.01 + 0.09
    np.testing.assert_allclose(slopes[:, 0, 0], -9.81 * 0.3 * np.cos(angles[:, 0]) / inertia, rtol=1e-8)
    np.testing.assert_allclose(slopes[:, 0, 1], -0.1 / inertia, rtol=1e-8)


def test_a_command_within_a_step_counts_from_when_it_comes() -> None:
    weightless = Model(MjcfRobot("p", pendulum().replace("<option ", '<option gravity="0 0 0" ')))
    inertia = 0.02 + 0.01 + 1.0 * 0.3**2

    def path(dt: float, when: float) -> Array:
        trial = Trial(
            "t", np.array([0.0, when]), np.array([[0.0], [3.0]]), np.zeros(1), 0.0, np.zeros(1), np.array([0.0, 1.0])
        )
        return simulate([weightless], [trial], dt=dt, check=False)[0].position[0, -1]

    for when in (0.1003, 0.1017):
        np.testing.assert_allclose(path(5e-3, when), 3.0 / inertia * (1 - when) ** 2 / 2, rtol=1e-9)


# --- which engine -----------------------------------------------------------------------------------------------


def test_the_engine_says_why_it_was_taken() -> None:
    exact = engine_for(Model(CRANE))
    assert isinstance(exact, ReducedEngine) and exact.discretisation is None
    assert exact.sentence == "Engine: reduced (compiled equations of motion hold all of the robot)."
    asked = engine_for(Model(CRANE), "mujoco")
    assert isinstance(asked, MujocoEngine) and asked.reason == "it was asked for"


BALL = '<equality><connect body1="arm" anchor="0 0 0"/></equality>'


def test_what_the_equations_cannot_hold_runs_on_mujoco() -> None:
    robot = MjcfRobot("p", pendulum(tail=BALL))
    found = engine_for(Model(robot))
    assert isinstance(found, MujocoEngine)
    assert found.reason == "compiled equations of motion cannot hold equality constraint 0 of kind connect"
    with pytest.raises(
        ConfigError, match="cannot hold equality constraint 0 of kind connect; expected --engine mujoco"
    ):
        engine_for(Model(robot), "reduced")


def chain(n: int) -> str:
    """MJCF of n links, each on a hinge with an axis of its own."""
    axes = ("1 0.2 0", "0.1 1 0.3", "0 0.4 1")
    inner = ""
    for i in reversed(range(n)):
        joint = f'<joint name="j{i}" axis="{axes[i % 3]}"/>'
        mass = '<inertial pos="0.1 0.02 -0.1" mass="1" diaginertia="0.02 0.03 0.04"/>'
        inner = f'<body name="b{i}" pos="0 0.1 -0.2">{joint}{mass}{inner}</body>'
    motor = '<actuator><motor name="drive" joint="j0"/></actuator>'
    return f"<mujoco><worldbody>{inner}</worldbody>{motor}</mujoco>"


@pytest.mark.parametrize(("n", "name"), [(7, "reduced"), (25, "mujoco"), (60, "mujoco")])
def test_trees_that_take_minutes_to_compile_run_on_mujoco(n: int, name: str) -> None:
    model = Model(MjcfRobot("chain", chain(n)))
    found = engine_for(model)
    assert found.name == name
    if name == "mujoco":
        assert found.reason == f"equations of motion of {n} joints would take minutes to compile"
        assert engine_for(model, "reduced").name == "reduced"


def test_contacts_that_happen_run_on_mujoco() -> None:
    floor = '<geom name="ball" type="sphere" size="0.1" pos="0 0 -0.6" mass="0"/>'
    text = pendulum(body=floor).replace(
        "<worldbody>", '<worldbody><geom name="wall" type="plane" pos="0.4 0 0" zaxis="-1 0 0" size="1 1 1"/>'
    )
    model = Model(MjcfRobot("p", text))
    free, touching = np.array([[0.0], [0.1]]), np.array([[0.0], [-1.2]])
    assert engine_for(model, positions=[free]).name == "reduced"
    found = engine_for(model, positions=[free, touching])
    assert found.name == "mujoco" and "'wall' touches 'ball' in the recordings" in found.reason


def test_a_step_of_the_engines_own_choice_hides_below_any_noise() -> None:
    """A stiff servo asks for shorter steps than a pendulum."""
    soft, stiff = (
        MjcfRobot("p", pendulum(drive=f'<position name="motor" joint="pivot" kp="{kp}" kv="{kv}"/>'))
        for kp, kv in ((5, 0.5), (20000, 60))
    )
    chosen = []
    for robot in (soft, stiff):
        times = np.arange(0.0, 1.0, 0.1)
        commands = 0.3 * np.sign(np.sin(9 * times))[:, None]
        samples = np.linspace(0.0, 1.0, 101)
        trial = Trial("t", times, commands, commands[0], 0.0, np.zeros(1), samples)
        engine, start = ReducedEngine(), [np.zeros((1, 2))]
        found = engine.simulate([Model(robot)], [trial], start)[0].position[0]
        fine = ReducedEngine(dt=5e-5).simulate([Model(robot)], [trial], start)[0].position[0]
        assert np.sqrt(((found - fine) ** 2).mean()) < 1e-3 * fine.std()
        assert engine.step is not None
        chosen.append(engine.step)
    assert chosen[1] < chosen[0] <= 3e-3


def test_the_first_model_simulated_decides_the_step() -> None:
    """Two hypotheses are to differ by their physics alone: whatever comes later has the same step."""
    drive = '<position name="motor" joint="pivot" kp="{}" kv="{}"/>'
    soft, stiff = (Model(MjcfRobot("p", pendulum(drive=drive.format(*gains)))) for gains in ((5, 0.5), (20000, 60)))
    times = np.arange(0.0, 0.5, 0.1)
    commands = 0.3 * np.sign(np.sin(9 * times))[:, None]
    trial = Trial("t", times, commands, commands[0], 0.0, np.zeros(1), np.linspace(0.0, 0.5, 51))
    steps = []
    for order in ((soft, stiff), (stiff, soft)):
        engine = ReducedEngine()
        assert engine.step is None
        chosen = [engine.simulate([model], [trial], [np.zeros((1, 2))]) and engine.step for model in order]
        assert chosen[0] == chosen[1]
        steps.append(chosen[0])
    assert steps[1] < steps[0]


def test_numbers_of_a_trial_are_its_own() -> None:
    trial = swinging()
    heavy = replace(trial, factors={"rod.mass": 2.0})
    robot = RIG.with_parameters({"rod.mass": 2.0 * RIG.parameters()["rod.mass"]})
    both = simulate([Model(RIG)], [trial, heavy], dt=1e-3, check=False)
    alone = simulate([Model(robot)], [trial], dt=1e-3, check=False)
    np.testing.assert_allclose(both[1].position, alone[0].position, rtol=0, atol=1e-12)
    assert np.abs(both[0].position - both[1].position).max() > 1e-3


def test_a_servo_that_follows_its_goal_closely_is_simulated_finely() -> None:
    """What tells of it is far less than it moves: only a sensor's noise says how fine a step has to be."""
    servo = Model(MjcfRobot("p", pendulum(drive='<position name="motor" joint="pivot" kp="4000" kv="60"/>')))
    time = np.linspace(0, 2, 2001)
    goal = 0.5 * np.sin(2 * np.pi * time)[:, None]
    trial = Trial("goal", time, goal, goal[0], 0.0, np.zeros(1), time, np.array([np.pi]))
    start = [np.array([[0.0, np.pi]])]
    exact = ReducedEngine(dt=2e-5).simulate([servo], [trial], start)[0].position[0]
    rng, errors = np.random.default_rng(0), []
    for noise in (1e-3, 1e-7):
        engine = engine_for(servo, positions=[exact + rng.normal(0, noise, exact.shape)])
        errors.append(float(np.abs(engine.simulate([servo], [trial], start)[0].position[0] - exact).max()))
    assert errors[1] < 1e-6 < 1e-4 < errors[0] < 1e-3


def test_noise_is_what_third_differences_show() -> None:
    rng, time = np.random.default_rng(1), np.linspace(0, 5, 1001)
    smooth = np.column_stack([np.sin(3 * time), 0.2 * time])
    found = noise_of([smooth + rng.normal(0, (1e-3, 1e-4), smooth.shape), smooth[:2]])
    assert found is not None and found == pytest.approx([1e-3, 1e-4], rel=0.1)
    assert noise_of([smooth[:3]]) is None
