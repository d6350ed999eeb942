"""A run in MuJoCo's viewer, over and over: the robot, and the recorded motion or the reference as a ghost."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.errors import ConfigError, EquimusError, NotAvailable, one_line
from equimus_ctrl.models.model import Model
from equimus_ctrl.report.film import make_film
from equimus_ctrl.report.film_frames import seen_robot
from equimus_ctrl.scenarios.scoring import on_grid
from equimus_ctrl.types import Array, Recording, Run

FPS = 60.0
HOST = "127.0.0.1"
"""Where a page is served: to this computer alone."""
SIZE = (1200, 800)
LOOKED_AT = 50
"""Poses that the camera is chosen by."""
GHOST = "ghost/"
GHOST_COLOUR = (0.35, 0.6, 0.9, 0.3)


@dataclass(frozen=True, eq=False)
class Shown:
    """What a viewer is given.

    Attributes:
        model: MuJoCo's, of the robot and its ghost.
        time: (n,) [s].
        qpos: (n, nq) of both.
        ghost: what the ghost does, in words.
    """

    model: Any
    time: Array
    qpos: Array
    ghost: str


def shown_of(run: Run, model: Model, recorded: Recording | None = None) -> Shown:
    """The robot as the run went, and as a ghost the recorded motion, or the reference where there is none.

    Args:
        run: what happened.
        model: whose robot is shown.
        recorded: of the real robot; before and behind it the ghost stands still.

    Raises:
        ConfigError: where the run is not of the model's robot.
    """
    film = make_film(run, model, FPS, *SIZE)
    ghost, what = film.wanted, "the reference"
    if recorded is not None:
        ghost, what = on_grid(recorded.time, recorded.position, film.time), f"the recording {recorded.name}"
    spec, own = seen_robot(film)
    other, beside = seen_robot(replace(film, position=ghost))
    _fade(other)
    spec.attach(other, prefix=GHOST, frame=spec.worldbody.add_frame())
    both = spec.compile()
    assert both.nq == own.shape[1] + beside.shape[1]  # the ghost's bodies come last
    qpos = np.hstack([own, beside])
    _look_at(both, qpos)
    return Shown(both, film.time, qpos, what)


def _look_at(model: Any, qpos: Array) -> None:
    """Have a viewer's camera begin with all that moves in sight."""
    data, places = mujoco.MjData(model), []
    solid = model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE)
    for pose in qpos[:: max(len(qpos) // LOOKED_AT, 1)]:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        places.append(data.geom_xpos[solid].copy())
    seen = np.concatenate(places)
    if len(seen):
        low, high = seen.min(axis=0), seen.max(axis=0)
        model.stat.center[:] = (low + high) / 2
        model.stat.extent = max(float(np.linalg.norm(high - low)), 1e-3)


def _fade(spec: Any) -> None:
    """Make all that is seen of a robot translucent, and nothing of it touch."""
    for geom in spec.geoms:
        geom.rgba, geom.material, geom.contype, geom.conaffinity = GHOST_COLOUR, "", 0, 0
    for tendon in spec.tendons:
        tendon.rgba, tendon.material = GHOST_COLOUR, ""
    for light in list(spec.lights):
        spec.delete(light)


def check_viewer(web: bool = False) -> str:
    """How the viewer is opened, before anything is simulated: ``web`` for a page, "" for a window.

    Args:
        web: whether a page is asked for; without a screen it is one anyway.

    Raises:
        NotAvailable: where MuJoCo's viewer cannot be loaded.
    """
    try:
        from mujoco.studio import app, launch_passive  # noqa: F401
    except (ImportError, OSError) as error:
        raise NotAvailable(
            f"MuJoCo's viewer cannot be loaded ({one_line(str(error))}); pip install mujoco-studio=="
            f"{mujoco.__version__} brings it"
        ) from None
    return "web" if web or not has_screen() else ""


def has_screen() -> bool:
    """Whether a window can be seen; where it cannot, MuJoCo's viewer ends the process."""
    linux = sys.platform.startswith("linux")
    return not linux or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def check_host(host: str) -> str:
    """The address of an interface of this computer.

    Args:
        host: its address, or a name of it.

    Raises:
        ConfigError: where nothing can be served there.
    """
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as own:
            own.bind(place)
    except (OSError, UnicodeError) as error:
        raise ConfigError(
            f"--view-web-host is {host!r}, which is no address of this computer ({one_line(str(error))}); expected "
            f"one, such as {HOST}, or 0.0.0.0 for all of them"
        ) from None
    return str(place[0])


def put(shown: Shown, data: Any, at: float) -> None:
    """Put the robot and its ghost where they are so long after the beginning [s], which begins anew at the end."""
    length = float(shown.time[-1] - shown.time[0]) + 1 / FPS
    k = min(int((at % length) * FPS), len(shown.time) - 1)
    data.qpos[:], data.qvel[:], data.time = shown.qpos[k], 0.0, shown.time[k]


def view(shown: Shown, how: str, host: str = HOST) -> None:
    """Open MuJoCo's viewer, and return when it is closed or Ctrl-C is pressed.

    What it prints goes to standard error.

    Args:
        shown: what is seen.
        how: see ``check_viewer``.
        host: address of the interface on which a page is served, see ``check_host``.

    Raises:
        NotAvailable: where it cannot be opened.
    """
    from mujoco.studio import app, launch_passive, viewer_handle, viewer_protocol

    from equimus_ctrl.report.viewer_plugin import Playback

    data = mujoco.MjData(shown.model)
    put(shown, data, 0.0)
    config = viewer_protocol.ViewerConfig(title="equimus-ctrl", gfx=how, open_browser=True)
    plugins = [app.App(), Playback(partial(put, shown))]
    try:
        with contextlib.redirect_stdout(sys.stderr):
            if how == "web":
                from equimus_ctrl.report.viewer_page import launch_page

                with launch_page(config, plugins, host) as handle:
                    handle.set_model(shown.model, data=data)
                    viewer_handle.run_sim_loop(handle)
            else:
                launch_passive.run(config, model=shown.model, data=data, plugins=plugins)
    except EquimusError:
        raise
    except Exception as error:
        other = "" if how == "web" else "; --view-web shows it in a browser"
        raise NotAvailable(f"MuJoCo's viewer cannot be opened here ({one_line(str(error))}){other}") from None
