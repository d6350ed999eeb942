"""A ball before a robot."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest
from learning_cases import ARM

from equimus_ctrl.errors import ModelError
from equimus_ctrl.models.ball import BALL, TOUCH, Ball, add_ball
from equimus_ctrl.models.mjcf import SolverSettings, compile_model
from equimus_ctrl.robots.elastic.leg import nominal_leg

WALL = """<mujoco><option timestep="0.0005" gravity="0 0 -9.8"/><worldbody><body name="wall" pos="0 0 0.3">
  <joint name="held" type="slide" axis="1 0 0"/><geom name="wall" type="box" size="0.1 0.3 0.3" mass="1e6"/>
  </body></worldbody></mujoco>"""

WITHOUT_GEOMS = re.sub(r"<geom type[^>]*/>", '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>', ARM)


def test_it_lies_where_it_is_put_and_nothing_else_touches() -> None:
    model = compile_model(
        nominal_leg(), settings=SolverSettings(), scene=lambda spec: add_ball(spec, (0.5, 0.0, -0.5), "foot")
    )
    data = mujoco.MjData(model)
    for _ in range(1200):
        mujoco.mj_step(model, data)
    assert data.body(BALL).xpos == pytest.approx([0.5, 0.0, -0.5], abs=1e-3)
    assert np.abs(data.joint(BALL).qvel).max() < 1e-3
    touching = {frozenset(model.geom(int(g)).name for g in c.geom) for c in data.contact}
    assert touching == {frozenset(("ball", "plate"))}
    assert data.sensor(TOUCH).data == pytest.approx(0.0)  # the plate is not the kicker


@pytest.mark.parametrize("restitution", [0.3, 0.7])
def test_it_comes_back_from_a_wall_as_it_says(restitution: float) -> None:
    ball = Ball(mass=0.2, contact_time=0.02, restitution=restitution, friction=0.0)
    spec = mujoco.MjSpec.from_string(WALL)
    add_ball(spec, (0.2, 0.0, 0.3), "wall", ball)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.joint(BALL).qvel[0] = -2.0
    touched, force, pushed = 0.0, 0.0, 0.0
    for _ in range(400):
        mujoco.mj_step(model, data)
        own = data.sensor(TOUCH).data
        touched += model.opt.timestep * (np.linalg.norm(own) > 0)
        force, pushed = max(force, float(np.abs(own[0]))), pushed + float(own[0]) * model.opt.timestep
    speed = data.joint(BALL).qvel[0]
    assert speed == pytest.approx(2.0 * restitution, rel=0.1)
    assert touched == pytest.approx(0.02, rel=0.2)
    assert abs(pushed) == pytest.approx(0.2 * (2.0 + speed), rel=0.02)  # momentum
    assert force > abs(pushed) / 0.02


def test_what_cannot_be_is_a_sentence() -> None:
    for key, value in (
        ("radius", 0.0),
        ("mass", -1.0),
        ("contact_time", np.inf),
        ("restitution", 1.0),
        ("restitution", 0.1),
    ):
        with pytest.raises(ModelError, match=key):
            Ball(**{key: value})
    with pytest.raises(ModelError, match="no site or body 'fot'; did you mean 'foot'"):
        compile_model(nominal_leg(), scene=lambda spec: add_ball(spec, (0, 0, 0), "fot"))
    with pytest.raises(ModelError, match="has no geom"):
        add_ball(mujoco.MjSpec.from_string(WITHOUT_GEOMS), (0, 0, 0), "hand")
    spec = mujoco.MjSpec.from_string(ARM)
    add_ball(spec, (0, 0, 0), "hand")
    with pytest.raises(ModelError, match="a robot without one"):
        add_ball(spec, (0, 0, 0), "hand")
