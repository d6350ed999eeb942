"""Frames that make equations short: the robot stays the same, however its joints lie to each other."""

from __future__ import annotations

from typing import Any

import casadi as ca
import mujoco
import numpy as np
import pytest

from equimus_ctrl.models.symbolic import build
from equimus_ctrl.robots.mjcf.packing import pack
from equimus_ctrl.robots.mjcf.reading import form_of

INERTIAL = '<inertial pos="{} {} {}" euler="0.3 0.2 0.1" mass="{}" diaginertia="0.02 0.018 0.007"/>'


def arm(joints: list[str], branch: int | None = None, places: Any = None) -> Any:
    """A chain of joints, their attributes given; from ``branch`` on they hang on the first body."""
    rng = np.random.default_rng(len(joints))
    opening, bodies = [], []
    for i, joint in enumerate(joints):
        place = rng.uniform(-0.2, 0.2, 3) if places is None else places[i]
        inertial = INERTIAL.format(*rng.uniform(-0.1, 0.1, 3), rng.uniform(0.2, 2))
        opening.append(f'<body pos="{" ".join(map(str, place))}"><joint name="j{i}" {joint}/>{inertial}')
    if branch is None:
        bodies = ["".join(opening) + "</body>" * len(opening)]
    else:
        first, second = "".join(opening[1:branch]), "".join(opening[branch:])
        inner = first + "</body>" * (branch - 1) + second + "</body>" * (len(opening) - branch)
        bodies = [opening[0] + inner + "</body>"]
    xml = (
        f'<mujoco><compiler angle="radian"/><option gravity="1 2 -9"/><worldbody>{"".join(bodies)}</worldbody></mujoco>'
    )
    return mujoco.MjModel.from_xml_string(xml)


def apart(m: Any, seed: int = 0) -> float:
    """Largest difference of mass matrix and bias to MuJoCo's, relative to their largest entries."""
    form = form_of(m)
    own, numbers = build(form, "swing"), pack(form, m)
    equations = ca.Function("e", [own.q, own.v, own.p], [own.mass, own.smooth_bias])
    data, rng, worst = mujoco.MjData(m), np.random.default_rng(seed), 0.0
    for _ in range(10):
        data.qpos[:], data.qvel[:] = rng.normal(size=m.nq), 2 * rng.normal(size=m.nv)
        mujoco.mj_forward(m, data)
        mass = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, data, mass)
        found = [np.array(part) for part in equations(data.qpos, data.qvel, numbers)]
        for one, other in zip(found, (mass, data.qfrc_bias[:, None]), strict=True):
            worst = max(worst, np.abs(one - other).max() / np.abs(other).max())
    return worst


@pytest.mark.parametrize("tilt", [0.0, 1e-15, 1e-13, 1e-10, 1e-7, 1e-4, 1e-2, 0.3, np.pi / 2, np.pi - 1e-9, np.pi])
def test_axes_may_be_as_good_as_parallel(tilt: float) -> None:
    """The common normal of two axes that are nearly parallel is far away, or anywhere."""
    c, s = np.cos(tilt), np.sin(tilt)
    axes = ["0.2 0.5 1", "0.2 0.5 1", f"{0.2 * c + s} {0.5 * c} {c}", f"{0.2 * c + s} {0.5 * c} {c}", "1 0 0"]
    assert apart(arm([f'axis="{axis}"' for axis in axes])) < 1e-12


@pytest.mark.parametrize("seed", range(12))
def test_hinges_and_slides_of_any_direction(seed: int) -> None:
    rng = np.random.default_rng(seed)
    joints = []
    for _ in range(5):
        axis = np.eye(3)[rng.integers(3)] if rng.random() < 0.5 else rng.normal(size=3)
        kind, ref, pos = ("slide", "hinge")[rng.integers(2)], rng.normal(), rng.normal(0, 0.2, 3)
        joints.append(f'type="{kind}" axis="{" ".join(map(str, axis))}" ref="{ref}" pos="{" ".join(map(str, pos))}"')
    assert apart(arm(joints)) < 1e-12
    assert apart(arm(joints, branch=3)) < 1e-12


def test_axes_that_meet_in_one_point_and_joints_of_one_body() -> None:
    joints = ['axis="0 0 1"', 'axis="0 1 0"/><joint name="more" axis="1 0 1"', 'axis="1 0 0"']
    assert apart(arm(joints, places=np.zeros((3, 3)))) < 1e-12


def test_every_link_of_a_chain_is_turned_about_its_parents_first_axis_alone_and_lies_on_it() -> None:
    rng = np.random.default_rng(1)
    form = form_of(arm([f'axis="{" ".join(map(str, rng.normal(size=3)))}"' for _ in range(6)]))
    for link in form.links[1:]:
        assert link.turn[0] == 1.0 and link.turn[1:4] == (0.0, 0.0, 0.0) and link.turn[6] == 0.0
        assert link.place[1] == 0.0
    assert form.links[1].place[2] == 0.0  # where the base is does not matter
