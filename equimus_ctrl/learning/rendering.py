"""Pictures of a robot and what stands around it, and a window."""

from __future__ import annotations

import os
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.errors import NotAvailable, one_line
from equimus_ctrl.learning.episodes import ROBOT, Episodes
from equimus_ctrl.learning.evaluation import Act
from equimus_ctrl.report.film import Frame
from equimus_ctrl.report.film_frames import OFF
from equimus_ctrl.report.film_geoms import Camera, camera_around, outlined
from equimus_ctrl.report.viewing import has_screen

SIZE = (480, 360)
"""Width and height of a picture [pixel]."""
ROOM = 1.5
"""Beside the robot as it begins, for where it moves, over its size."""


class Pictures:
    """Pictures of robots: by MuJoCo where ``MUJOCO_GL`` names an OpenGL backend, else as outlines of their geoms.

    A backend that nobody chose may take the whole process down. The camera stays where the first picture had it.
    """

    def __init__(self) -> None:
        self._cameras: dict[int, Camera] = {}

    def __call__(self, row: int, model: Any, data: Any) -> Frame:
        """A robot as it is.

        Args:
            row: which robot.
            model: MuJoCo's.
            data: its data, with places of geoms.

        Returns:
            (height, width, 3).

        Raises:
            NotAvailable: where the backend does not render.
        """
        width, height = SIZE
        if row not in self._cameras:
            self._cameras[row] = camera_around(model, data, width, height, ROOM)
        camera = self._cameras[row]
        if os.environ.get("MUJOCO_GL", "").strip().lower() in ("", *OFF):
            return outlined(model, data, camera, width, height)
        view = mujoco.MjvCamera()
        view.lookat[:], view.distance = camera.lookat, camera.distance
        view.azimuth, view.elevation = camera.azimuth, camera.elevation
        try:
            with mujoco.Renderer(model, height, width) as renderer:
                renderer.update_scene(data, view)
                return np.array(renderer.render())
        except Exception as error:
            raise NotAvailable(
                f"MuJoCo cannot render here ({one_line(str(error))}); MUJOCO_GL=off draws outlines"
            ) from None


def film_of(episodes: Episodes, act: Act, robot: int, seed: int, fps: float = 30.0) -> tuple[list[Frame], float]:
    """Pictures of one episode, and how many a second there are in real time.

    Args:
        episodes: of one robot at least.
        act: what is seen doing the task.
        robot: which of those that can be drawn.
        seed: of start and noise.
        fps: about how many a second are wanted.
    """
    pictures, row = Pictures(), np.array([0])
    rate = episodes.plant.rates.control
    every = max(round(rate / fps), 1)
    episodes.begin(0, np.random.default_rng([seed, robot]), {ROBOT: robot})
    frames = [pictures(0, *episodes.plant.seen(0))]
    for period in range(episodes.periods):
        done = episodes.step(row, act(episodes.observation(row), period))
        if not (period + 1) % every:
            frames.append(pictures(0, *episodes.plant.seen(0)))
        if done.terminated[0]:
            break
    return frames, rate / every


class Window:
    """MuJoCo's viewer.

    Args:
        model: what is shown.

    Raises:
        NotAvailable: where there is no window to be had.
    """

    def __init__(self, model: Any) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        if not has_screen():
            raise NotAvailable("there is no screen for a window; render_mode='rgb_array' gives pictures")
        try:
            from mujoco import viewer

            self._viewer = viewer.launch_passive(model, self._data)
        except Exception as error:
            raise NotAvailable(
                f"no window can be opened here ({one_line(str(error))}); render_mode='rgb_array' gives pictures"
            ) from None

    def shows(self, model: Any) -> bool:
        """Whether this is the model shown."""
        return model is self._model

    def show(self, data: Any) -> None:
        """Show a state."""
        self._data.qpos[:] = data.qpos
        mujoco.mj_forward(self._model, self._data)
        self._viewer.sync()

    def close(self) -> None:
        """Close it."""
        self._viewer.close()
