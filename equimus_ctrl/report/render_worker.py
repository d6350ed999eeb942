"""Renders a film in a process of its own and writes raw RGB frames to standard output.

OpenGL's backend is chosen when MuJoCo is first imported, and a broken driver can take its process down; here neither
reaches the caller. Run as a script, with ``MUJOCO_GL`` set: ``render_worker.py MODEL.mjb FILM.npz``.
"""

from __future__ import annotations

import sys
from typing import Any

import mujoco
import numpy as np

NOWHERE, UPRIGHT = np.zeros(3), np.eye(3).ravel()


def render(model_path: str, film_path: str) -> None:
    """Write one frame for each row of the film's qpos, as height × width × 3 bytes."""
    model = mujoco.MjModel.from_binary_path(model_path)
    data = mujoco.MjData(model)
    with np.load(film_path) as archive:
        film = dict(archive)
    height, width = (int(side) for side in film["size"])
    camera = mujoco.MjvCamera()
    camera.lookat[:] = film["lookat"]
    camera.distance, camera.azimuth, camera.elevation = (float(value) for value in film["view"])
    option = mujoco.MjvOption()
    option.sitegroup[:] = 0
    with mujoco.Renderer(model, height, width) as renderer:
        for k, qpos in enumerate(film["qpos"]):
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, camera, option)
            _decorate(renderer.scene, data, film, film["trail"], k)
            sys.stdout.buffer.write(np.ascontiguousarray(renderer.render()).tobytes())
    sys.stdout.buffer.flush()


def _decorate(scene: Any, data: Any, film: dict[str, Any], trail: Any, k: int) -> None:
    for i, (origin, insertion) in enumerate(film["actuator_sites"]):
        ends = data.site_xpos[origin], data.site_xpos[insertion]
        _connect(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, float(film["radii"][k, i]), *ends, film["colours"][k, i])
    for start, end in film["target"]:
        _connect(scene, mujoco.mjtGeom.mjGEOM_LINE, 3.0, start, end, film["target_colour"])
    first = max(k - int(film["trail_frames"]), 0)
    for j in range(first, k):
        colour = film["trail_colour"].copy()
        colour[3] *= (j - first + 1) / (k - first)
        _connect(scene, mujoco.mjtGeom.mjGEOM_LINE, 4.0, trail[j], trail[j + 1], colour)


def _connect(scene: Any, kind: Any, width: float, start: Any, end: Any, colour: Any) -> None:
    if scene.ngeom >= scene.maxgeom:
        return
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, NOWHERE, NOWHERE, UPRIGHT, colour.astype(np.float32))
    mujoco.mjv_connector(geom, kind, width, start, end)
    scene.ngeom += 1


if __name__ == "__main__":
    render(*sys.argv[1:])
