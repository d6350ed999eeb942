"""Inertias of MJCF robots: physical whatever their numbers, and as many free as motion can tell apart."""

from __future__ import annotations

import casadi as ca
import mujoco
import numpy as np
import pytest

from equimus_ctrl import workflow
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.parameters import free_parameters, matching
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.robots.mjcf.independent import independent
from equimus_ctrl.robots.mjcf.inertia import SHAPE
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array

ARM = """<mujoco model="arm"><compiler angle="radian"/><option timestep="0.001"/><worldbody>
<body name="upper" pos="0 0 1"><joint name="shoulder" axis="0 1 0.2" damping="0.2"/>
<inertial pos="0.1 0.02 -0.15" mass="1.4" fullinertia="0.02 0.018 0.006 0.001 -0.002 0.0015"/>
<body name="fore" pos="0 0.05 -0.3"><joint name="elbow" axis="0.3 1 0" damping="0.1"/>
<inertial pos="0 0.03 -0.12" mass="0.8" diaginertia="0.008 0.007 0.002"/></body></body></worldbody>
<actuator><motor name="s" joint="shoulder"/><motor name="e" joint="elbow"/></actuator></mujoco>"""
PLANAR = ARM.replace('axis="0 1 0.2"', 'axis="0 1 0"').replace('axis="0.3 1 0"', 'axis="0 1 0"')


def arm(xml: str = ARM) -> MjcfRobot:
    return MjcfRobot("arm", xml)


def drawn(rng: np.random.Generator, reach: float) -> dict[str, float]:
    return {f"{body}.{kind}": float(rng.uniform(-reach, reach)) for body in ("upper", "fore") for kind in SHAPE}


def second_moments(model: object, body: str) -> Array:
    """(3, 3) of a body's mass about its centre, in its own axes."""
    b = model.body(body).id  # type: ignore[attr-defined]
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, model.body_iquat[b])  # type: ignore[attr-defined]
    turn = flat.reshape(3, 3)
    inertia = turn @ np.diag(model.body_inertia[b]) @ turn.T  # type: ignore[attr-defined]
    return np.trace(inertia) / 2 * np.eye(3) - inertia


@pytest.mark.parametrize("seed", range(8))
def test_no_numbers_give_a_body_that_cannot_be(seed: int) -> None:
    model = arm().with_parameters(drawn(np.random.default_rng(seed), 4.0)).mujoco_model()
    for body in ("upper", "fore"):
        moments = np.linalg.eigvalsh(second_moments(model, body))
        assert moments[0] > -1e-12 * moments[2]


def test_without_a_change_the_inertia_is_the_files() -> None:
    own, same = arm().mujoco_model(), arm().with_parameters(dict.fromkeys(drawn(np.random.default_rng(0), 0), 0.0))
    assert np.array_equal(own.body_inertia, same.mujoco_model().body_inertia)


def test_every_inertia_that_can_be_is_reached() -> None:
    """Shape and size of an inertia drawn at random are solved for, and come out as drawn."""
    rng = np.random.default_rng(3)
    own = arm().mujoco_model()
    file = np.linalg.eigvalsh(second_moments(own, "fore"))
    assert np.allclose(np.sort(0.0085 - own.body_inertia[own.body("fore").id]), file)
    wanted = np.diag([0.3, 0.2, 0.4]) + 0.05 * rng.normal(size=(3, 3))
    wanted = 1e-2 * wanted @ wanted.T
    # In the principal axes, which are the body's: S½ E Eᵀ S½·s = wanted, E upper triangular with determinant 1.
    root = np.sqrt(0.0085 - np.array([0.008, 0.007, 0.002]))
    inner = wanted / np.outer(root, root)
    flip = np.eye(3)[::-1]
    upper = flip @ np.linalg.cholesky(flip @ inner @ flip) @ flip
    size = np.cbrt(np.prod(np.diag(upper)))
    e = upper / size
    shape = np.log(e[0, 0]), np.log(e[1, 1]), e[0, 1], e[0, 2], e[1, 2]
    values = {f"fore.{kind}": float(v) for kind, v in zip(SHAPE, shape, strict=True)}
    model = arm().with_parameters({**values, "fore.inertia": 0.008 * size**2}).mujoco_model()
    assert np.allclose(second_moments(model, "fore"), wanted, rtol=0, atol=1e-12)


def test_the_order_in_which_numbers_are_given_does_not_matter() -> None:
    values = {**drawn(np.random.default_rng(1), 0.4), "fore.inertia": 0.01, "upper.mass": 2.0}
    one, other = (arm().with_parameters(dict(order)) for order in (values.items(), reversed(values.items())))
    assert np.array_equal(one.mujoco_model().body_inertia, other.mujoco_model().body_inertia)
    assert np.array_equal(one.mechanics().parameters, other.mechanics().parameters)


def test_the_equations_hold_such_bodies_as_mujoco_does() -> None:
    rng = np.random.default_rng(5)
    robot = arm().with_parameters(drawn(rng, 0.5))
    mechanics = robot.mechanics()
    own = build(mechanics.form, "swing")
    find = ca.Function("a", [own.q, own.v, own.f, own.tau, own.p], [own.acceleration])
    model = robot.mujoco_model()
    data = mujoco.MjData(model)
    for q, v in rng.normal(size=(4, 2, 2)):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        found = np.array(find(q, v, [0.0, 0.0], [0.0, 0.0], mechanics.parameters)).ravel()
        assert np.allclose(found, data.qacc, rtol=1e-9)


def test_base_parameters_span_all_that_masses_can_do() -> None:
    robot = arm()
    kinds = "mass", "com_x", "com_y", "com_z", "inertia", *SHAPE
    everything = [f"{body}.{kind}" for kind in kinds for body in ("upper", "fore")]
    base = robot.base_names()
    assert independent(robot, [*base, *everything]) == base
    assert len(base) == len(independent(robot, everything[::-1]))
    assert not independent(robot, []) and set(base) <= set(everything)


def test_a_planar_arm_of_two_links_has_six() -> None:
    """Of each link an inertia and two first moments, the mass beyond the elbow counted with the upper arm's."""
    assert len(arm(PLANAR).base_names()) == 6


def test_base_parameters_are_a_name_of_what_is_free() -> None:
    model = Model(arm())
    assert set(matching(model, ["base_parameters"])) == set(model.robot.base_names())
    free = free_parameters(model, ["base_parameters", "*.damping"])
    assert "elbow.damping" in free.names and len(free.names) == len(model.robot.base_names()) + 2


def test_a_leg_knows_no_base_parameters() -> None:
    with pytest.raises(ConfigError, match="base_parameters exist for MJCF robots alone"):
        matching(workflow.load_model(), ["base_parameters"])


def test_a_slip_of_the_name_is_told() -> None:
    with pytest.raises(ConfigError, match="did you mean 'base_parameters'"):
        matching(Model(arm()), ["base_parameter"])
