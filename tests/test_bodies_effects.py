"""Effects that change the robot: a payload against a point mass added by hand, and a base that is not level."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from morphologies import integrate, newton_acceleration, pendulum, random_morphology, random_poses

from equimus_ctrl.effects import Effect, GravityTilt, ParallelSpring, PayloadMass
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase
from equimus_ctrl.types import Array, Start

LEG = nominal_leg()
FREE = replace(LEG, joints=tuple(replace(j, lower=None, upper=None) for j in LEG.joints))


def tip(k: Kinematics, link: str, q: Array, phase: Phase) -> Array:
    """(2,) a link's tip, relative to what stands still [m]; chains only."""
    knot = k.knots(q)[1 + [one.name for one in k.morphology.links].index(link)]
    return knot - k.foot(q) if phase == "stance" else knot


def tip_jacobian(k: Kinematics, link: str, q: Array, phase: Phase) -> Array:
    """(2, nj) by central differences, good to 1e-10."""
    h = 1e-5
    shifts = h * np.eye(len(q))
    return np.stack([(tip(k, link, q + s, phase) - tip(k, link, q - s, phase)) / (2 * h) for s in shifts], axis=1)


def loaded(m: Morphology, link: str, mass: float, q: Array, v: Array, pressure: Array, phase: Phase) -> Array:
    """(nj,) accelerations with a point mass bolted to a link's tip: its inertia, weight and centrifugal force added."""
    k = Kinematics(m, phase)
    jacobian, h = tip_jacobian(k, link, q, phase), 1e-4
    turning = (tip(k, link, q + h * v, phase) - 2 * tip(k, link, q, phase) + tip(k, link, q - h * v, phase)) / h**2
    gravity = m.gravity * np.array([-np.sin(m.tilt), np.cos(m.tilt)])
    free = k.mass(q) @ newton_acceleration(m, q, v, pressure, phase=phase)
    total = k.mass(q) + mass * jacobian.T @ jacobian
    return np.linalg.solve(total, free + mass * jacobian.T @ (gravity - turning))


@pytest.mark.parametrize("phase", ["swing", "stance"])
@pytest.mark.parametrize("location", ["foot", "thigh", "calf"])
def test_a_payload_is_a_point_mass_at_the_tip(location: str, phase: Phase) -> None:
    robot = changed_bodies((PayloadMass(location, 0.17),), FREE)
    link = "calf" if location == "foot" else location
    rng = np.random.default_rng(5)
    for q in random_poses(FREE, rng, 5, 0.4, 1.4):
        v, p = rng.normal(0, 3, 2), rng.uniform(0, 3e4, 2)
        expected = loaded(FREE, link, 0.17, q, v, p, phase)
        np.testing.assert_allclose(newton_acceleration(robot, q, v, p, phase=phase), expected, rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(Kinematics(robot, phase).acceleration(q, v, p), expected, rtol=1e-5, atol=1e-4)


def test_a_mass_at_a_foot_that_stands_moves_nothing() -> None:
    robot, q, v = changed_bodies((PayloadMass("foot", 1.0),), FREE), np.array([1.3, 0.7]), np.array([1.0, -2.0])
    accelerations = [Kinematics(m, "stance").acceleration(q, v, [1e4, 2e3]) for m in (FREE, robot)]
    np.testing.assert_allclose(*accelerations, rtol=1e-10)


def test_masses_at_one_tip_add_up_in_any_order() -> None:
    one = changed_bodies((PayloadMass("foot", 0.1), PayloadMass("calf", 0.2)), LEG)
    whole = changed_bodies((PayloadMass("calf", 0.3),), LEG)
    np.testing.assert_allclose(list(one.parameters().values()), list(whole.parameters().values()), rtol=1e-14)
    assert changed_bodies((), LEG) is LEG


def test_the_foot_is_the_morphologys_own() -> None:
    m = random_morphology("branched", 3)
    for location, link in (("foot", m.foot), ("link0", "link0")):
        changed = changed_bodies((PayloadMass(location, 0.5),), m)
        assert changed.link(link).mass == pytest.approx(m.link(link).mass + 0.5)
        assert {one.name for one in changed.links if one != m.link(one.name)} == {link}


def moved(model: Model, start: Array, times: Array, pressure: Array) -> Array:
    one = Trial("t", np.zeros(1), pressure[None, :], pressure, 0.0, start, times)
    return simulate([model], [one], threads=1)[0].position[0]


CASES: dict[str, tuple[Effect, ...]] = {
    "payload": (PayloadMass("foot", 0.08),),
    "tilt": (GravityTilt("base", 0.15),),
    "both": (PayloadMass("thigh", 0.1), GravityTilt("base", -0.1), PayloadMass("foot", 0.05)),
}


@pytest.mark.parametrize("name", CASES)
def test_engine_and_plant_move_the_changed_robot(name: str) -> None:
    start, pressure, times = np.array([1.4, 0.6]), np.array([14e3, 4e3]), np.arange(61) / 120
    m = FREE
    tilt = 0.0
    for effect in CASES[name]:
        if isinstance(effect, GravityTilt):
            tilt += effect.angle
    m = replace(m, tilt=tilt)
    loads = [e for e in CASES[name] if isinstance(e, PayloadMass)]

    def acceleration(t: float, q: Array, v: Array) -> Array:
        # One point mass after another: each is added to what the ones before made.
        robot = m
        for effect in loads[:-1]:
            robot = changed_bodies((effect,), robot)
        if not loads:
            return newton_acceleration(robot, q, v, pressure)
        link = "calf" if loads[-1].location == "foot" else loads[-1].location
        return loaded(robot, link, loads[-1].mass, q, v, pressure, "swing")

    expected, _ = integrate(acceleration, start, np.zeros(2), times, rtol=1e-6, atol=1e-8)
    model = Model(FREE, CASES[name])
    np.testing.assert_allclose(moved(model, start, times, pressure), expected, rtol=0, atol=2e-6)
    assert np.abs(expected - moved(Model(FREE), start, times, pressure)).max() > 0.01
    plant = MujocoPlant(model)
    seen = [plant.reset(Start(position=start, command=pressure)).position]
    seen += [plant.step(pressure).position for _ in range(60)]
    np.testing.assert_allclose(seen, expected, rtol=0, atol=3e-5)
    # Controllers know the robot as it is described, not what was attached to it.
    assert plant.spec.model == FREE


@pytest.mark.parametrize("angle", [-0.7, 0.2, 1.1])
def test_a_pendulum_on_a_tilted_base_hangs_along_gravity(angle: float) -> None:
    rod = pendulum()
    rod = replace(rod, joints=(replace(rod.joints[0], damping=0.2),))
    model = Model(rod, (GravityTilt("base", angle),))
    found = moved(model, np.array([np.pi / 2]), np.array([0.0, 12.0]), np.zeros(1))
    assert found[-1, 0] == pytest.approx(np.pi / 2 + angle, abs=1e-6)


def test_a_tilt_turns_gravity_and_nothing_else() -> None:
    """A robot whose base, and all that hangs on it, is turned against gravity: springs and all."""
    model = Model(LEG, (GravityTilt("base", 0.2), ParallelSpring("hip", 1.0, 1.2)))
    robot = changed_bodies(model.effects, model.morphology)
    assert robot == replace(LEG, tilt=LEG.tilt + 0.2)
    q = np.array([1.3, 0.4])
    weights = [Kinematics(m).acceleration(q, [0, 0], [0, 0]) for m in (LEG, robot, replace(LEG, tilt=0.4))]
    # Accelerations are linear in the gravity vector (−sin, cos).
    rows = np.array([[1.0, -np.sin(a), np.cos(a)] for a in (0.0, 0.2, 0.4)])
    rest = Kinematics(replace(LEG, tilt=0.9)).acceleration(q, [0, 0], [0, 0])
    np.testing.assert_allclose(
        np.array([1.0, -np.sin(0.9), np.cos(0.9)]) @ np.linalg.solve(rows, weights), rest, rtol=1e-8
    )


def test_what_a_payload_does_is_seen_at_rest() -> None:
    pressure = np.array([12e3, 4e3])
    heavy = changed_bodies((PayloadMass("foot", 0.1),), LEG)
    rest = Kinematics(heavy).equilibrium(pressure)
    still = moved(Model(LEG, (PayloadMass("foot", 0.1),)), rest, np.linspace(0, 2, 21), pressure)
    np.testing.assert_allclose(still, np.tile(rest, (21, 1)), rtol=0, atol=1e-9)
    assert np.abs(rest - Kinematics(LEG).equilibrium(pressure)).max() > 0.02
