"""The MuJoCo model has the energies, accelerations and motion of the exact one, stops included."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from morphologies import STRUCTURES, integrate, newton_acceleration, pendulum, random_morphology, random_poses

from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ModelError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import SolverSettings, build_spec, close_elements, compile_model
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.leg import ideal_leg, nominal_leg
from equimus_ctrl.robots.elastic.morphology import JointStop, Morphology, Phase, Point
from equimus_ctrl.types import Array

PHASES: tuple[Phase, ...] = ("swing", "stance")
FINE = SolverSettings(timestep=1 / 480, integrator="RK4")

every_phase = pytest.mark.parametrize("phase", PHASES)
every_structure = pytest.mark.parametrize("name", STRUCTURES)


class Simulated:
    """A morphology in MuJoCo, with its joints found by name."""

    def __init__(self, morphology: Morphology, phase: Phase = "swing", settings: SolverSettings | None = None) -> None:
        self.morphology, self.phase = morphology, phase
        self.model = compile_model(morphology, phase, settings)
        self.data = mujoco.MjData(self.model)
        self.qpos = [self.model.joint(name).qposadr[0] for name in morphology.joint_names]
        self.dof = [self.model.joint(name).dofadr[0] for name in morphology.joint_names]

    def place(self, q: Array, v: Array, pressure: Array) -> None:
        """Into a state, in stance with the foot on its foothold; independent of what the library's plant does."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self.qpos], self.data.qvel[self.dof] = q, v
        if self.phase == "stance":
            k = Kinematics(self.morphology)
            for axis, at, rate in zip("xy", k.foot(q), k.foot_jacobian(q) @ v, strict=True):
                joint = self.model.joint(f"base/{axis}")
                self.data.qpos[joint.qposadr[0]], self.data.qvel[joint.dofadr[0]] = -at, -rate
        close_elements(self.model, self.data)
        self.data.ctrl[:] = pressure
        mujoco.mj_forward(self.model, self.data)

    def energies(self) -> tuple[float, float]:
        mujoco.mj_energyPos(self.model, self.data)
        mujoco.mj_energyVel(self.model, self.data)
        return float(self.data.energy[1]), float(self.data.energy[0])

    def gaps(self) -> tuple[float, float]:
        """Largest difference between the halves, and largest distance between an element's end and its site [m]."""
        halves, ends = [], []
        for a in self.morphology.actuators:
            slides = [self.data.qpos[self.model.joint(f"{a.name}/{half}").qposadr[0]] for half in ("middle", "lower")]
            halves.append(abs(slides[0] - slides[1]))
            sites = [self.data.site(name).xpos for name in (f"{a.name}/end", f"{a.name}/insertion")]
            ends.append(float(np.linalg.norm(sites[0] - sites[1])))
        return max(halves), max(ends)


def states(m: Morphology, seed: int, n: int = 4) -> list[tuple[Array, Array, Array]]:
    rng = np.random.default_rng(seed)
    nj, na = len(m.joints), len(m.actuators)
    return [(q, rng.normal(0, 3, nj), rng.uniform(0, 5e4, na)) for q in random_poses(m, rng, n)]


@every_phase
@every_structure
def test_energies_and_accelerations_are_those_of_the_exact_model(name: str, phase: Phase) -> None:
    """Stops pressed included.

    An equality of impedance d holds all but 1 − d = 1e-4 of the acceleration that would break it, so errors are
    measured against what the forces would do without the equalities.
    """
    for seed in range(3):
        m = random_morphology(name, seed, stops=True)
        k, simulated = Kinematics(m, phase), Simulated(m, phase)
        for q, v, p in states(m, seed):
            simulated.place(q, v, p)
            kinetic, potential = simulated.energies()
            exact = k.energy(q, v)
            assert kinetic == pytest.approx(exact[0], rel=1e-5)
            assert potential == pytest.approx(exact[1], rel=1e-5, abs=1e-7)
            expected = newton_acceleration(m, q, v, p, phase=phase)
            free = simulated.data.qacc_smooth[simulated.dof]
            error = np.abs(simulated.data.qacc[simulated.dof] - expected)
            assert error.max() < 1e-3 * max(np.abs(free).max(), np.abs(expected).max())


@pytest.mark.parametrize("make", [nominal_leg, ideal_leg])
def test_the_legs_accelerate_as_the_exact_model_to_a_thousandth(make: Callable[[], Morphology]) -> None:
    m = make()
    simulated = Simulated(m)
    rng = np.random.default_rng(1)
    for _ in range(30):
        q, v, p = rng.uniform([0.6, 0.0], [2.1, 1.5]), rng.normal(0, 3, 2), rng.uniform(0, 5e4, 2)
        simulated.place(q, v, p)
        expected = newton_acceleration(m, q, v, p)
        assert np.abs(simulated.data.qacc[simulated.dof] - expected).max() < 1e-3 * np.abs(expected).max()


@every_phase
@pytest.mark.parametrize("name", ["nominal_leg", "branched"])
def test_a_free_second_is_that_of_the_exact_model(name: str, phase: Phase) -> None:
    """At the plant's own step, without stops: these are hit at instants that fall within a step."""
    m = random_morphology(name, 1) if name in STRUCTURES else nominal_leg()
    m = replace(m, joints=tuple(replace(j, lower=None, upper=None) for j in m.joints))
    k, simulated = Kinematics(m, phase), Simulated(m, phase, FINE)
    rng = np.random.default_rng(11)
    q0 = np.array([1.3, 0.6]) if name == "nominal_leg" else random_poses(m, rng, 1)[0]
    v0, p = rng.normal(0, 1, len(m.joints)), rng.uniform(0, 1e4, len(m.actuators))
    times = np.linspace(0, 1, 25)
    q, _ = integrate(lambda t, q, v: k.acceleration(q, v, p), q0, v0, times, rtol=1e-8, atol=1e-10)
    assert np.ptp(q, axis=0).max() > 0.1
    simulated.place(q0, v0, p)
    for expected in q[1:]:
        for _ in range(20):
            mujoco.mj_step(simulated.model, simulated.data)
        np.testing.assert_allclose(simulated.data.qpos[simulated.qpos], expected, atol=1e-4)
    halves, ends = simulated.gaps()
    assert halves < 1e-5
    assert ends < 1e-5


@pytest.mark.parametrize("depth", [0.05, 0.3])
@pytest.mark.parametrize("rate", [-3.0, 0.0, 3.0, 60.0])
@pytest.mark.parametrize(("stiffness", "damping"), [(200.0, 1.0), (30.0, 0.0), (0.0, 2.0), (0.0, 0.0)])
@pytest.mark.parametrize("side", ["lower", "upper"])
def test_a_stop_is_a_spring_and_damper_that_never_pulls(
    side: str, stiffness: float, damping: float, rate: float, depth: float
) -> None:
    """A rate of 60 rad/s out of the stop would have its damper pull harder than its spring pushes."""
    base = pendulum()
    stop = JointStop(0.4 if side == "lower" else 1.4, stiffness, damping)
    drive = replace(base.actuators[0], mass=1e-6)
    m = replace(base, joints=(replace(base.joints[0], **{side: stop}),), actuators=(drive,))
    out = 1.0 if side == "lower" else -1.0  # the way out of the stop
    q, v = np.array([stop.angle - out * depth]), np.array([out * rate])
    simulated = Simulated(m)
    simulated.place(q, v, np.zeros(1))
    link = m.links[0]
    moment = link.inertia + link.mass * link.com**2
    push = out * max(stiffness * depth - damping * rate, 0.0)
    expected = (link.mass * 9.8 * link.com * math.cos(q[0]) + push) / moment
    assert simulated.data.qacc[simulated.dof][0] == pytest.approx(expected, rel=2e-4)


def test_a_link_comes_to_rest_as_deep_in_its_stop_as_its_spring_lets_it() -> None:
    base = pendulum()
    stop = JointStop(2.0, 50.0, 2.0)
    drive = replace(base.actuators[0], mass=1e-6)
    m = replace(base, joints=(replace(base.joints[0], lower=stop, damping=0.5),), actuators=(drive,))
    simulated = Simulated(m, settings=FINE)
    simulated.place(np.array([2.2]), np.zeros(1), np.zeros(1))
    for _ in range(5 * 480):
        mujoco.mj_step(simulated.model, simulated.data)
    q = simulated.data.qpos[simulated.qpos][0]
    weight = 0.7 * 9.8 * 0.25 * math.cos(q)
    assert 2.0 - q == pytest.approx(-weight / 50.0, rel=1e-3)


UNLIKE = {
    "hip.lower.angle": 1.3, "hip.lower.stiffness": 30.0, "hip.lower.damping": 0.2, "hip.upper.angle": 1.5,
    "knee.lower.angle": 0.75, "knee.lower.stiffness": 150.0, "knee.lower.damping": 1.0,
    "knee.upper.angle": 0.9, "knee.upper.stiffness": 8.0, "knee.upper.damping": 0.05,
}  # fmt: skip


@pytest.mark.parametrize("phase", PHASES)
def test_stops_that_differ_push_each_as_its_own(phase: Phase) -> None:
    """Accelerations in and out of both stops of both joints, those of a joint unlike."""
    m = nominal_leg().with_parameters(UNLIKE)
    k, simulated = Kinematics(m, phase), Simulated(m, phase)
    for q in ([1.2, 0.6], [1.2, 1.1], [1.6, 0.6], [1.6, 1.1], [1.4, 0.8]):
        for v in ([0.0, 0.0], [2.0, -3.0], [-2.0, 3.0]):
            p = np.array([9e3, 4e3])
            simulated.place(np.array(q), np.array(v), p)
            expected = k.acceleration(q, v, p)
            assert np.abs(simulated.data.qacc[simulated.dof] - expected).max() < 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize("phase", PHASES)
def test_a_leg_between_stops_that_differ_moves_as_the_exact_model(phase: Phase) -> None:
    m = nominal_leg().with_parameters(UNLIKE)
    commands = np.array([[20e3, 2e3], [2e3, 9e3], [20e3, 22e3], [2e3, 0.0]]) * (1.0 if phase == "swing" else 0.4)
    start, every = np.array([1.4, 0.85]), 16
    trial = Trial("t", np.arange(4) * 0.5, commands, commands[0], 0.0, start, np.arange(240) / 120)
    exact = simulate([Model(m, phase=phase)], [trial], dt=1e-4, threads=1)[0].position[0]
    low, high = m.joint_range
    assert np.all(exact.min(axis=0) < low) or np.all(exact.max(axis=0) > high)
    fine = SolverSettings(timestep=1 / 1920, integrator="RK4", softness=0.01)
    simulated = Simulated(m, phase, fine)
    simulated.place(start, np.zeros(2), commands[0])
    found = [start]
    for step in range(239 * every):
        simulated.data.ctrl[:] = commands[min(step // 960, 3)]
        mujoco.mj_step(simulated.model, simulated.data)
        if (step + 1) % every == 0:
            found.append(simulated.data.qpos[simulated.qpos].copy())
    np.testing.assert_allclose(found, exact, rtol=0, atol=6e-5)


def test_a_joint_may_have_one_stop_or_none() -> None:
    m = nominal_leg()
    hip, knee = m.joints
    model = compile_model(replace(m, joints=(replace(hip, lower=None), replace(knee, lower=None, upper=None))))
    assert model.joint("hip").limited[0] == 1
    assert model.joint("hip").range[0] < -100
    assert model.joint("hip").range[1] == pytest.approx(5 * math.pi / 6)
    assert model.joint("knee").limited[0] == 0


@pytest.mark.parametrize("phase", PHASES)
def test_masses_add_up_and_elements_are_split_one_four_one(phase: Phase) -> None:
    m = nominal_leg()
    model = compile_model(m, phase)
    total = sum(link.mass for link in m.links) + sum(a.mass for a in m.actuators)
    assert model.body_mass.sum() == pytest.approx(total + (m.base_mass if phase == "stance" else 0.0), rel=1e-12)
    for a in m.actuators:
        masses = [model.body(f"{a.name}/{part}").mass[0] for part in ("upper", "middle", "lower")]
        np.testing.assert_allclose(masses, np.array([1, 4, 1]) / 6 * a.mass, rtol=1e-12)


def test_a_tilted_base_leans_gravity_towards_minus_x() -> None:
    gravity = compile_model(replace(nominal_leg(), tilt=0.2)).opt.gravity
    np.testing.assert_allclose(gravity, [-9.8 * math.sin(0.2), 0, -9.8 * math.cos(0.2)], rtol=1e-14)


def test_closing_gives_an_element_the_velocity_of_its_ends() -> None:
    m = nominal_leg()
    k, simulated = Kinematics(m), Simulated(m)
    q, v = np.array([1.1, 0.7]), np.array([2.0, -3.0])
    simulated.place(q, v, np.zeros(2))
    for a, length, rate in zip(m.actuators, k.lengths(q), k.jacobian(q) @ v, strict=True):
        for half in ("middle", "lower"):
            joint = simulated.model.joint(f"{a.name}/{half}")
            assert simulated.data.qpos[joint.qposadr[0]] == pytest.approx(length / 2, rel=1e-9)
            assert simulated.data.qvel[joint.dofadr[0]] == pytest.approx(rate / 2, rel=1e-7)
    halves, ends = simulated.gaps()
    assert halves < 1e-12
    assert ends < 1e-12


def test_an_element_without_length_is_named() -> None:
    m = pendulum()
    ends = replace(m.actuators[0], mass=0.1, origin=Point("base", 0.2), insertion=Point("rod", 0.2))
    model = compile_model(replace(m, actuators=(ends,)))
    with pytest.raises(ModelError, match=r"actuator 'drive' has no length at this pose, so its direction is undefined"):
        close_elements(model, mujoco.MjData(model))


def test_closing_a_model_without_elements_changes_nothing() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = 0.3, 2.0
    close_elements(model, data)
    assert (data.qpos[0], data.qvel[0]) == (0.3, 2.0)


def test_a_massless_actuator_is_refused_by_name() -> None:
    with pytest.raises(ModelError, match=r"actuator 'drive': mass is 0, expected more than 0"):
        compile_model(pendulum())


def test_the_spec_of_a_morphology_can_be_written_and_read_as_xml() -> None:
    spec = build_spec(nominal_leg())
    spec.compile()
    model = mujoco.MjModel.from_xml_string(spec.to_xml())
    assert model.nq == compile_model(nominal_leg()).nq
    assert model.nu == 2
