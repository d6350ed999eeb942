"""Films of MJCF robots: the camera sees all that moves, outlines lie where MuJoCo renders, and strips read any command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mjcf_models import PENDULUM, RIG
from PIL import Image

from equimus_ctrl.errors import NotAvailable
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import make_spec
from equimus_ctrl.report.film import Film, Strip, make_film
from equimus_ctrl.report.film_frames import MujocoPictures, sketch_of
from equimus_ctrl.report.film_geoms import Geoms, camera_for
from equimus_ctrl.report.video import save_video
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Run
from equimus_ctrl.workflow import load_model

EXAMPLES = Path(__file__).parent.parent / "docs" / "examples"
TURNING = """<mujoco model="turning"><compiler angle="radian"/><worldbody>
  <geom type="plane" size="3 3 0.1"/>
  <body name="post" pos="1 2 0.3"><joint name="yaw" axis="0 0 1"/>
    <geom type="cylinder" size="0.05 0.2" contype="0" conaffinity="0"/>
    <body name="beam"><joint name="pitch" axis="0 1 0"/>
      <geom type="box" pos="0.4 0 0" size="0.4 0.03 0.03" rgba="0.9 0.2 0.1 1" contype="0" conaffinity="0"/>
      <site name="tip" pos="0.8 0 0"/></body></body></worldbody>
  <actuator><motor name="a" joint="yaw"/><motor name="b" joint="pitch"/></actuator></mujoco>"""


def moving(model: Model, joints: Array, command: Array | None = None) -> Run:
    """A run in which joints go from 0 to some positions in a second; they are wanted there."""
    robot = model.robot
    n, na = 60, len(robot.actuator_names)
    time = np.arange(n) / 60
    position = np.linspace(0, 1, n)[:, None] * joints
    commands = np.zeros((n, na)) if command is None else command
    spec = make_spec(robot, 1 / 60, None)
    still = np.tile(joints, (n, 1))
    clipped = np.zeros((n, na), bool)
    return Run(spec, time, position, still, commands, commands, clipped, np.zeros(n), np.zeros(na))


CASES = {
    "cart": (load_model(EXAMPLES / "cartpole.xml"), np.array([1.2, 3.0])),
    "rods": (load_model(EXAMPLES / "pendulum.xml"), np.array([1.5])),
    "room": (Model(MjcfRobot("turning", TURNING)), np.array([2.5, -0.7])),
    "rig": (Model(RIG), np.array([0.7, 0.1])),
}


def film_of(name: str, width: int = 240, height: int = 200) -> Film:
    model, joints = CASES[name]
    return make_film(moving(model, joints), model, 8, width, height)


@pytest.mark.parametrize("name", CASES)
def test_the_camera_sees_all_that_moves_and_not_much_more(name: str) -> None:
    film = film_of(name)
    geoms = Geoms(film)
    seen = []
    for qpos in geoms.qpos:
        data = geoms.place(qpos)
        for g in geoms.shown:
            if geoms.model.body_weldid[geoms.model.geom_bodyid[g]]:
                size = geoms.model.geom_rbound[g] / np.sqrt(3)
                seen.append(data.geom_xpos[g] + 0.5 * size * np.eye(3))
    places, deep = geoms.camera.pixels(np.concatenate([*seen, geoms.target, geoms.trail]), film.width, film.height)
    assert deep.min() > 0
    assert places.min() >= 0 and np.all(places.max(axis=0) <= (film.width, film.height))
    assert np.max(np.ptp(places, axis=0) / (film.width, film.height)) > 0.4


def test_the_camera_looks_along_the_axis_about_which_a_robot_swings() -> None:
    forward = Geoms(film_of("cart")).camera.axes[2]
    assert abs(forward[0]) < 1e-6 and forward[1] > 0.9 and -0.2 < forward[2] < 0
    flat = np.random.default_rng(0).normal(size=(50, 3)) * (1.0, 1.0, 0.0)
    assert camera_for(flat, flat, 200, 200).axes[2][2] < -0.8  # from above


@pytest.mark.parametrize("name", CASES)
def test_outlines_are_where_mujoco_renders(name: str) -> None:
    film = film_of(name)
    try:
        pictures = MujocoPictures(film)
    except NotAvailable as error:
        pytest.skip(str(error))
    rendered = list(pictures)
    pictures.close()
    outlines = list(sketch_of(film))
    assert len(rendered) == len(outlines) == len(film.time)
    for k in (0, len(rendered) - 1):
        # What has moved is at the same place; floors, light and shadow take no part.
        other = len(rendered) // 2
        changed = [np.abs(np.subtract(p[k], p[other], dtype=np.int64)).max(axis=2) > 60 for p in (rendered, outlines)]
        both, either = (changed[0] & changed[1]).sum(), (changed[0] | changed[1]).sum()
        assert both > 0.5 * either > 0


def test_bars_go_either_way_from_nothing() -> None:
    model = load_model(EXAMPLES / "cartpole.xml")
    command = np.where(np.arange(60)[:, None] < 30, -1.0, 0.5)
    film = make_film(moving(model, np.array([0.5, 1.0]), command), model, 8, 720, 100)
    strip, blank = Strip(film), np.full((100, 720, 3), 255, np.uint8)
    columns = []
    for k in (0, len(film.time) - 1):
        bars = np.flatnonzero((strip.under(blank, k)[100:] == (230, 159, 0)).all(axis=2).any(axis=0))
        columns.append((bars.min(), bars.max()))
    (left, middle), (begins, right) = columns
    assert abs(begins - middle) <= 2 and (right - begins) == pytest.approx((middle - left) / 2, abs=3)
    wild = Model(PENDULUM)
    assert np.all(np.isinf(make_spec(wild.robot, 0.01, None).command_high))
    free = make_film(moving(wild, np.array([1.0]), 4 * command), wild, 8, 240, 100)
    assert (free.fill.min(), free.fill.max(), free.empty[0]) == (0.0, 0.75, 0.5)


def test_a_film_without_opengl_says_how_it_is_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "off")
    model, joints = CASES["cart"]
    done = save_video(moving(model, joints), model, tmp_path / "cart.gif", fps=5)
    assert done.renderer == "pillow" and done.note.endswith("so the robot's geoms are drawn as outlines")
    with Image.open(done.path) as image:
        assert image.n_frames == 5  # type: ignore[attr-defined]
        before = np.asarray(image.convert("RGB"))[:400].astype(int)
        image.seek(4)
        after = np.asarray(image.convert("RGB"))[:400].astype(int)
    assert (np.abs(after - before).max(axis=2) > 60).sum() > 1000
