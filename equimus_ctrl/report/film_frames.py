"""Pictures of a film: rendered by MuJoCo where OpenGL works, drawn with matplotlib anywhere."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from equimus_ctrl.errors import NotAvailable
from equimus_ctrl.models.mjcf import build_spec, close_elements, point_position
from equimus_ctrl.report import film_geoms, style
from equimus_ctrl.report.drawing import MM, base_span, bracket_points, sketch
from equimus_ctrl.report.film import Film, Frame
from equimus_ctrl.types import Array

WORKER = Path(__file__).with_name("render_worker.py")
OFF = ("0", "off", "disable", "disabled", "false", "no")
FIRST_FRAME_TIME = 60.0  # [s] after which a backend is given up
FIELD_OF_VIEW = 30.0  # [degree]
SAMPLES = 2  # a pixel
ELEVATION = -4.0  # [degree]
ROPE = 0.02
"""Width of an elastic actuator in a viewer, in lengths of all links."""


def gl_backends() -> list[str]:
    """Values of ``MUJOCO_GL`` to try, the user's own first; an empty text leaves the choice to MuJoCo."""
    asked = os.environ.get("MUJOCO_GL", "").strip().lower()
    if asked in OFF:
        return []
    candidates = [asked] if asked else []
    if sys.platform == "linux":
        candidates += ["egl", "osmesa", *(["glfw"] if os.environ.get("DISPLAY") else [])]
    else:
        candidates.append("")
    return list(dict.fromkeys(candidates))


class MujocoPictures:
    """Pictures rendered by MuJoCo in a process of its own, with the first OpenGL backend that works.

    Args:
        film: what is shown.

    Attributes:
        backend: the OpenGL backend in use.

    Raises:
        NotAvailable: where none renders.
    """

    def __init__(self, film: Film) -> None:
        self._count = len(film.time)
        self._shape = (film.height, film.width, 3)
        self._folder = tempfile.TemporaryDirectory(prefix="equimus-video-")
        folder = Path(self._folder.name)
        try:
            write_scene(film, folder / "model.mjb", folder / "film.npz")
            self._first, self.backend = self._start(folder)
        except BaseException:
            self._folder.cleanup()
            raise

    def _start(self, folder: Path) -> tuple[Frame, str]:
        failures = []
        for backend in gl_backends():
            errors = folder / "errors.txt"
            environment = {key: value for key, value in os.environ.items() if key != "PYOPENGL_PLATFORM"}
            environment["MUJOCO_GL"] = backend
            with errors.open("wb") as log:
                # -P keeps this folder's modules from hiding others of the same name.
                self._process = subprocess.Popen(
                    [sys.executable, "-P", str(WORKER), str(folder / "model.mjb"), str(folder / "film.npz")],
                    stdout=subprocess.PIPE,
                    stderr=log,
                    env=environment,
                )
            watchdog = threading.Timer(FIRST_FRAME_TIME, self._process.kill)
            watchdog.start()
            try:
                first = self._read()
            finally:
                watchdog.cancel()
            if first is not None and np.ptp(first) > 8:
                return first, backend or "default"
            self._stop()
            said = errors.read_text(errors="replace").strip().splitlines()
            why = said[-1].strip() if first is None and said else "the picture is blank"
            failures.append(f"{backend or 'default'}: {why[:120]}")
        reason = "; ".join(failures) or f"MUJOCO_GL is {os.environ.get('MUJOCO_GL')!r}"
        raise NotAvailable(f"MuJoCo cannot render here ({reason})")

    def _read(self) -> Frame | None:
        assert self._process.stdout is not None
        size = self._shape[0] * self._shape[1] * self._shape[2]
        data = self._process.stdout.read(size)
        return np.frombuffer(data, np.uint8).reshape(self._shape) if len(data) == size else None

    def _stop(self) -> None:
        self._process.kill()
        self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def __iter__(self) -> Iterator[Frame]:
        """The pictures in order.

        Raises:
            NotAvailable: where rendering stops before the end.
        """
        yield self._first
        for k in range(1, self._count):
            picture = self._read()
            if picture is None:
                raise NotAvailable(f"MuJoCo's renderer ({self.backend}) stopped after {k} of {self._count} pictures")
            yield picture

    def close(self) -> None:
        """End the process and remove its files."""
        self._stop()
        self._folder.cleanup()


def write_scene(film: Film, model_path: Path, film_path: Path) -> None:
    """Write the MuJoCo model and what the render worker needs to draw it."""
    drawn = _elastic_scene if has_elements(film) else film_geoms.scene
    model, arrays = drawn(film)
    np.savez(film_path, size=np.array([film.height, film.width]), trail_frames=np.array(film.trail_frames), **arrays)
    mujoco.mj_saveModel(model, str(model_path), None)


def has_elements(film: Film) -> bool:
    """Whether links in a plane and elastic actuators are shown; else the geoms of the robot's own file."""
    return "lengths" in film.model.robot.offers


def sketch_of(film: Film) -> SketchPictures | film_geoms.GeomPictures:
    """Pictures of a film that need no OpenGL."""
    return SketchPictures(film) if has_elements(film) else film_geoms.GeomPictures(film)


def _elastic_scene(film: Film) -> tuple[Any, dict[str, Any]]:
    """The MuJoCo model of a robot with elastic actuators, and what the render worker needs beside."""
    model, m = _elastic_spec(film).compile(), film.morphology
    qpos = _elastic_poses(film, model)
    low, high = film.box
    middle, half = (low + high) / 2, 0.56 * (high - low)
    tangent = np.tan(np.radians(FIELD_OF_VIEW) / 2)
    distance = max(half[1] / tangent, half[0] / tangent * film.height / film.width) + 0.05 * film.size
    lookat = np.array([middle[0], 0.0, -middle[1]])
    slope = np.radians(ELEVATION)
    eye = lookat - distance * np.array([0.0, np.cos(slope), np.sin(slope)])
    target = _dashes(film)
    traced = np.column_stack([film.traced[:, 0], np.zeros(len(qpos)), -film.traced[:, 1]])
    return model, {
        "qpos": qpos,
        "lookat": lookat,
        "view": np.array([distance, 90.0, ELEVATION]),
        # Nearer to the eye on the same line of sight: the path shows at its place and is not hidden by the leg.
        "trail": traced + 0.05 * (eye - traced),
        "actuator_sites": np.array(
            [[model.site(f"{name}/{end}").id for end in ("origin", "insertion")] for name in m.actuator_names]
        ),
        "radii": film.size * (0.024 + 0.014 * film.fill),
        "colours": np.array([[(*film.colour(i, f), 1.0) for i, f in enumerate(row)] for row in film.fill]),
        "target": target + 0.051 * (eye - target),
        "target_colour": np.array([0.0, 0.0, 0.0, 1.0]),
        "trail_colour": np.array([0.42, 0.24, 0.60, 1.0]),
    }


def _elastic_poses(film: Film, model: Any) -> Array:
    """(n, nq) of a model of ``_elastic_spec``, its elements closed."""
    data = mujoco.MjData(model)
    joints = [model.joint(name).qposadr[0] for name in film.morphology.joint_names]
    base = [model.joint(f"base/{axis}").qposadr[0] for axis in "xy"] if film.phase == "stance" else []
    qpos = np.empty((len(film.time), model.nq))
    for k, angles in enumerate(film.position):
        data.qpos[joints] = angles
        data.qpos[base] = film.bones.base[k][: len(base)]
        close_elements(model, data)
        qpos[k] = data.qpos
    return qpos


def seen_robot(film: Film) -> tuple[Any, Array]:
    """MuJoCo's specification of the robot with what is seen of it, and (n, nq) its poses.

    Elastic actuators are spatial tendons between their ends, so that any viewer draws them.
    """
    if not has_elements(film):
        return film_geoms.seen_spec(film), film_geoms.Geoms(film).qpos
    spec = _elastic_spec(film)
    qpos = _elastic_poses(film, spec.compile())
    for i, name in enumerate(film.morphology.actuator_names):
        rope = spec.add_tendon(name=f"{name}/seen", width=ROPE * film.size, rgba=(*film.colour(i, 1.0), 1.0))
        for end in ("origin", "insertion"):
            rope.wrap_site(f"{name}/{end}")
    return spec, qpos


def _dashes(film: Film) -> Array:
    """(m, 2, 3) the target as dashes, or as a cross where it is one point, in MuJoCo's coordinates."""
    path = film.target
    if len(path) == 1:
        cross = 0.02 * film.size * np.array([[[-1.0, 0.0], [1.0, 0.0]], [[0.0, -1.0], [0.0, 1.0]]])
        dashed = path[0] + cross
    else:
        dashed = np.stack([path[:-5:10], path[5::10]], axis=1)
        dashed = dashed[np.isfinite(dashed).all(axis=(1, 2))][:1000]
    return np.stack([dashed[..., 0], np.zeros(dashed.shape[:2]), -dashed[..., 1]], axis=-1)


def _elastic_spec(film: Film) -> Any:
    m, size = film.morphology, film.size
    spec = build_spec(m, film.phase)
    view = spec.visual
    view.global_.offwidth, view.global_.offheight, view.global_.fovy = film.width, film.height, FIELD_OF_VIEW
    view.headlight.ambient, view.headlight.diffuse, view.headlight.specular = (0.45,) * 3, (0.3,) * 3, (0.05,) * 3
    view.map.znear = 0.01
    view.quality.offsamples = SAMPLES
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=(1.0, 1.0, 1.0),
        rgb2=(1.0, 1.0, 1.0),
        width=64,
        height=64,
    )
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        dir=(0.4, 1.0, -0.8),
        diffuse=(0.25,) * 3,
        specular=(0.05,) * 3,
        castshadow=False,
    )
    look = {"contype": 0, "conaffinity": 0, "mass": 0.0}
    left, right = base_span(m)
    thick = 0.02 * size
    spec.body("base").add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=((left + right) / 2, 0.0, thick),
        size=((right - left) / 2, 0.06 * size, thick),
        rgba=(0.62, 0.64, 0.68, 1.0),
        **look,
    )
    for joint in m.joints:
        spec.body(joint.child).add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            fromto=(0.0, -0.05 * size, 0.0, 0.0, 0.05 * size, 0.0),
            size=(0.034 * size, 0.0, 0.0),
            rgba=(0.25, 0.27, 0.32, 1.0),
            **look,
        )
    spec.body(m.foot).add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        pos=(m.link(m.foot).length, 0.0, 0.0),
        size=(0.03 * size, 0.0, 0.0),
        rgba=(0.6, 0.63, 0.68, 1.0),
        **look,
    )
    for axis, point in bracket_points(m):
        spec.body(point.body).add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=(*point_position(axis), *point_position(point)),
            size=(0.012 * size, 0.0, 0.0),
            rgba=(0.6, 0.63, 0.68, 1.0),
            **look,
        )
    if film.phase == "stance":
        low, high = film.box
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=((low[0] + high[0]) / 2, 0.0, -0.012 - thick),
            size=((high[0] - low[0]) / 2, 0.2 * size, thick),
            rgba=(0.9, 0.9, 0.9, 1.0),
            **look,
        )
    return spec


class SketchPictures:
    """Pictures drawn as lines with matplotlib.

    Args:
        film: what is shown.
    """

    backend, said = "matplotlib", "the leg is drawn as lines"

    def __init__(self, film: Film) -> None:
        self.film = film

    def __iter__(self) -> Iterator[Frame]:
        """The pictures in order."""
        film = self.film
        figure = Figure(figsize=(film.width / 100, film.height / 100), dpi=100, facecolor="white")
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        low, high = (corner * MM for corner in film.box)
        middle, half = (low + high) / 2, 0.56 * (high - low)
        scale = max(half[0] / film.width, half[1] / film.height)
        target, traced = film.target * MM, film.traced * MM
        goal: dict[str, Any] = {"marker": "+", "markersize": 14, "markeredgewidth": 2} if len(target) == 1 else {}
        for k, pose in enumerate(film.position):
            axes.clear()
            axes.set_axis_off()
            axes.set_xlim(middle[0] - scale * film.width, middle[0] + scale * film.width)
            axes.set_ylim(middle[1] + scale * film.height, middle[1] - scale * film.height)
            sketch(axes, film.morphology, pose, film.phase)
            axes.plot(*target.T, color=style.REFERENCE, linestyle=style.DASHES, zorder=6, **goal)
            trail = traced[max(k - film.trail_frames, 0) : k + 1]
            axes.plot(*trail.T, color=style.FOOT, linewidth=2.5, zorder=5)
            canvas.draw()  # type: ignore[no-untyped-call]
            yield np.asarray(canvas.buffer_rgba())[:, :, :3].copy()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Nothing to let go of."""
