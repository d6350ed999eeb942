"""Films of MJCF robots: their own geoms, rendered by MuJoCo, or as outlines where there is no OpenGL.

Bodies without any geom that would be seen get rods from their origin to the joints that they carry and to their centre
of mass. The camera looks along the direction in which least moves, and is far enough away to see all of the motion.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from PIL import Image, ImageDraw
from scipy.spatial import ConvexHull, QhullError

from equimus_ctrl.report import style
from equimus_ctrl.report.film import Film, Frame
from equimus_ctrl.robots.mjcf.plan import spec_of
from equimus_ctrl.robots.mjcf.robot import mjcf_of
from equimus_ctrl.types import Array

FIELD_OF_VIEW = 30.0  # [degree]
STEEPEST, FLATTEST = -60.0, -8.0
"""Elevations of the camera [degree]: what moves level is looked at from above, and anything a little."""
ROOM = 1.12
"""What everything takes of the picture, times this, is all of it."""
SEEN_GROUPS = 3
"""MuJoCo shows geoms of so many groups where nobody says otherwise."""
NEAR = 0.05
"""The path is drawn so much of the way nearer to the eye, so that the robot does not hide it."""
LOOKED_AT = 120
"""Poses from which the camera is placed, at most."""
ROD = 0.03
"""Radius of rods that stand for bodies without geoms, of the longest's length."""
AROUND = 0.25
"""Of the size of what moves, how much of what stands still beside it is to be seen."""
SHARPER = 2
"""Outlines are drawn so many times as large first."""
PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
CROSS = 0.02
"""Size of the mark where a path is one point, of the way to the camera."""


@dataclass(frozen=True, eq=False)
class Camera:
    """MuJoCo's free camera.

    Attributes:
        lookat: (3,) where it looks [m].
        distance: from there [m].
        azimuth: about the vertical [degree].
        elevation: below 0 looks down [degree].
    """

    lookat: Array
    distance: float
    azimuth: float
    elevation: float

    @property
    def axes(self) -> Array:
        """(3, 3) rows: to the right, up and forwards in the picture."""
        azimuth, slope = np.radians([self.azimuth, self.elevation])
        forward = np.array([np.cos(slope) * np.cos(azimuth), np.cos(slope) * np.sin(azimuth), np.sin(slope)])
        right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        rows: Array = np.array([right, np.cross(right, forward), forward])
        return rows

    @property
    def eye(self) -> Array:
        """(3,) where it is [m]."""
        return np.asarray(self.lookat - self.distance * self.axes[2])

    def pixels(self, points: Array, width: int, height: int) -> tuple[Array, Array]:
        """(n, 2) places in a picture, from the upper left, and (n,) depths [m] of points (n, 3) [m]."""
        right, up, deep = self.axes @ (points - self.eye).T
        scale = height / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2) / deep
        return np.stack([width / 2 + scale * right, height / 2 - scale * up], axis=1), deep


def camera_for(moving: Array, seen: Array, width: int, height: int) -> Camera:
    """The camera that sees points.

    Args:
        moving: (n, 3) of what moves, by which the direction is chosen [m].
        seen: (m, 3) of all that is to be in the picture [m].
        width: of the picture [pixel].
        height: [pixel].
    """
    spread = np.cov(moving.T) if len(moving) > 1 else np.zeros((3, 3))
    # Of directions in which as little moves that of the y axis is taken.
    least = np.linalg.eigh(spread + 1e-9 * max(np.trace(spread), 1e-12) * np.diag([1.0, 0.0, 0.5]))[1][:, 0]
    across = least[:2] if np.linalg.norm(least[:2]) > 0.3 else np.array([0.0, 1.0])
    across = across * (-1.0 if across[1] < -1e-9 or (abs(across[1]) <= 1e-9 and across[0] > 0) else 1.0)
    steep = float(np.clip(-np.degrees(np.arcsin(min(abs(least[2]), 1.0))), STEEPEST, FLATTEST))
    view = Camera(np.zeros(3), 0.0, float(np.degrees(np.arctan2(across[1], across[0]))), steep)
    right, up, deep = view.axes @ seen.T
    tangent = np.tan(np.radians(FIELD_OF_VIEW) / 2) / ROOM
    middle = np.array([(part.max() + part.min()) / 2 for part in (right, up, deep)])
    for _ in range(8):  # perspective makes what is near larger than what is far
        distances = np.maximum(
            np.abs(right - middle[0]) / (tangent * width / height), np.abs(up - middle[1]) / tangent
        ) - (deep - middle[2])
        distance = float(distances.max())
        scale = 1.0 / (distance + deep - middle[2])
        across_, along = (right - middle[0]) * scale, (up - middle[1]) * scale
        middle[0] += distance * (across_.max() + across_.min()) / 2
        middle[1] += distance * (along.max() + along.min()) / 2
    return Camera(view.axes.T @ middle, max(distance, 1e-3), view.azimuth, view.elevation)


class Geoms:
    """An MJCF robot's geoms over a film.

    Args:
        film: what is shown.

    Attributes:
        model: MuJoCo's, with what is seen.
        qpos: (n, nq) in each frame.
        trail: (n, 3) the path of what sticks out and moves farthest [m].
        target: (k, 3) where that is wanted; one row where it stays [m].
    """

    def __init__(self, film: Film) -> None:
        self.film = film
        self.model = seen_spec(film).compile()
        self._data = mujoco.MjData(self.model)
        joints = [int(self.model.joint(name).qposadr[0]) for name in film.spec.joints]
        poses = []
        for values in (film.position, film.reference[:: max(len(film.reference) // 1000, 1)]):
            qpos = np.tile(self.model.qpos0, (len(values), 1))
            qpos[:, joints] = values
            poses.append(qpos)
        self.qpos = poses[0]
        robot = mjcf_of(film.model.robot)
        names = robot.ends["foot"] or robot.ends["link"]
        kind = "site" if robot.ends["foot"] else "body"
        paths, targets = ([self._path(kind, name, qpos) for name in names] for qpos in poses)
        self.trail, self.target = np.zeros((len(self.qpos), 3)), np.zeros((0, 3))
        if names:
            farthest = int(np.argmax([np.ptp(path, axis=0).sum() for path in paths]))
            self.trail, self.target = paths[farthest], targets[farthest]
            if np.ptp(self.target, axis=0).max() < 1e-9:
                self.target = self.target[:1]

    def place(self, qpos: Array) -> Any:
        """MuJoCo's data in a pose."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_comPos(self.model, self._data)
        return self._data

    def _path(self, kind: str, name: str, poses: Array) -> Array:
        places = []
        for qpos in poses:
            data = self.place(qpos)
            places.append((data.site(name).xpos if kind == "site" else data.body(name).xipos).copy())
        return np.array(places)

    @cached_property
    def shown(self) -> list[int]:
        """Geoms that are seen, planes last."""
        return seen_geoms(self.model)

    @cached_property
    def camera(self) -> Camera:
        """See ``camera_for``."""
        model, film = self.model, self.film
        moving, still = [self.trail], []
        solid = [g for g in self.shown if int(model.geom_type[g]) != PLANE]
        for k, qpos in enumerate(self.qpos[:: max(len(self.qpos) // LOOKED_AT, 1)]):
            data = self.place(qpos)
            for g in solid:
                points = _corners(model, data, g)
                if model.body_weldid[model.geom_bodyid[g]]:
                    moving.append(points)
                elif k == 0:
                    still.append(points)
        moved = np.concatenate(moving)
        low, high = moved.min(axis=0), moved.max(axis=0)
        room = AROUND * float(np.max(high - low))
        beside = [np.clip(points, low - room, high + room) for points in still]
        near = [points for points, own in zip(beside, still, strict=True) if _meets(own, low - room, high + room)]
        seen = np.concatenate([moved, *near, self.target])
        return camera_for(self._motion(), seen, film.width, film.height)

    def _motion(self) -> Array:
        """(n, 3) where bodies and the path are beside their middles [m]: how they move, whatever their shape."""
        moves = [b for b in range(1, self.model.nbody) if self.model.body_weldid[b]]
        some = self.qpos[:: max(len(self.qpos) // LOOKED_AT, 1)]
        found = np.array([self.place(qpos).xipos[moves] for qpos in some])
        return np.concatenate([(found - found.mean(axis=0)).reshape(-1, 3), self.trail - self.trail.mean(axis=0)])


def _meets(points: Array, low: Array, high: Array) -> bool:
    return bool(np.all(points.min(axis=0) <= high) and np.all(points.max(axis=0) >= low))


def scene(film: Film) -> tuple[Any, dict[str, Any]]:
    """The MuJoCo model, and what the render worker needs beside."""
    geoms = Geoms(film)
    camera, n = geoms.camera, len(film.time)
    eye = camera.eye
    target = dashes(geoms)
    return geoms.model, {
        "qpos": geoms.qpos,
        "lookat": camera.lookat,
        "view": np.array([camera.distance, camera.azimuth, camera.elevation]),
        "trail": geoms.trail + NEAR * (eye - geoms.trail),
        "actuator_sites": np.zeros((0, 2), dtype=np.int64),
        "radii": np.zeros((n, 0)),
        "colours": np.zeros((n, 0, 4)),
        "target": target + (NEAR + 1e-3) * (eye - target),
        "target_colour": np.array([0.0, 0.0, 0.0, 1.0]),
        "trail_colour": np.array([0.42, 0.24, 0.60, 1.0]),
    }


def dashes(geoms: Geoms) -> Array:
    """(m, 2, 3) the target as dashes, or as a cross where it is one point [m]."""
    path = geoms.target
    if len(path) == 1:
        right, up, _ = CROSS * geoms.camera.distance * geoms.camera.axes
        return np.asarray(path[0] + np.array([[-right, right], [-up, up]]))
    return np.stack([path[:-5:10], path[5::10]], axis=1)[:1000] if len(path) > 10 else np.zeros((0, 2, 3))


def seen_spec(film: Film) -> Any:
    """MuJoCo's specification of a robot's file with what is seen of it."""
    robot = mjcf_of(film.model.robot)
    spec = spec_of(robot.xml, robot.beside_xml)
    plain = spec.compile()
    for body in spec.bodies:
        if plain.body_weldid[plain.body(body.name).id if body.name else body.id] == 0:
            continue
        geoms = list(body.geoms)
        if any(geom.group < SEEN_GROUPS for geom in geoms):
            continue
        if geoms:
            for geom in geoms:
                geom.group = 0
            continue
        _add_rods(body, plain)
    view = spec.visual
    view.global_.offwidth, view.global_.offheight, view.global_.fovy = film.width, film.height, FIELD_OF_VIEW
    view.headlight.ambient, view.headlight.diffuse, view.headlight.specular = (0.45,) * 3, (0.4,) * 3, (0.05,) * 3
    if not list(spec.lights):
        spec.worldbody.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=(0.4, 1.0, -0.8), diffuse=(0.25,) * 3,
            specular=(0.05,) * 3, castshadow=False,
        )  # fmt: skip
    view.map.znear = 0.01
    view.quality.offsamples = 2
    if not any(int(texture.type) == int(mujoco.mjtTexture.mjTEXTURE_SKYBOX) for texture in spec.textures):
        spec.add_texture(
            name="film/sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
            rgb1=(1.0, 1.0, 1.0), rgb2=(1.0, 1.0, 1.0), width=64, height=64,
        )  # fmt: skip
    return spec


def _add_rods(body: Any, plain: Any) -> None:
    look = {"contype": 0, "conaffinity": 0, "mass": 0.0, "rgba": (0.45, 0.5, 0.58, 1.0), "group": 0}
    own = plain.body(body.name).id
    ends = [plain.body_pos[b] for b in range(plain.nbody) if plain.body_parentid[b] == own and b != own]
    ends.append(plain.body_ipos[own])
    begins = plain.jnt_pos[plain.body_jntadr[own]] if plain.body_jntnum[own] else np.zeros(3)
    lengths = [float(np.linalg.norm(end - begins)) for end in ends]
    radius = ROD * (max(lengths) or float(plain.stat.extent))
    for end, length in zip(ends, lengths, strict=True):
        if length > 1e-9:
            rod = {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "fromto": (*begins, *end), "size": (radius, 0.0, 0.0)}
            body.add_geom(**rod, **look)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=tuple(ends[-1]), size=(2 * radius, 0.0, 0.0), **look)


def _colour(model: Any, g: int) -> Array:
    """(4,) the colour of a geom, or of its material."""
    material = int(model.geom_matid[g])
    return np.asarray(model.mat_rgba[material] if material >= 0 else model.geom_rgba[g])


class GeomPictures:
    """Pictures of geoms as outlines, the nearest last.

    Args:
        film: what is shown.
    """

    backend, said = "pillow", "the robot's geoms are drawn as outlines"

    def __init__(self, film: Film) -> None:
        self.film = film

    def __iter__(self) -> Iterator[Frame]:
        """The pictures in order."""
        film, geoms = self.film, Geoms(self.film)
        camera, size = geoms.camera, (SHARPER * film.width, SHARPER * film.height)
        surfaces = _surfaces(geoms.model, geoms.shown)
        lines = [camera.pixels(dash, *size)[0] for dash in dashes(geoms)]
        trail = camera.pixels(geoms.trail, *size)[0]
        for k, qpos in enumerate(geoms.qpos):
            image = Image.new("RGB", size, "white")
            draw = ImageDraw.Draw(image)
            _draw(draw, geoms.model, geoms.place(qpos), surfaces, camera, size)
            for line in lines:
                draw.line([tuple(p) for p in line], fill=style.REFERENCE, width=2 * SHARPER)
            path = trail[max(k - film.trail_frames, 0) : k + 1]
            if len(path) > 1:
                draw.line([tuple(p) for p in path], fill=style.FOOT, width=2 * SHARPER)
            yield np.asarray(image.resize((film.width, film.height), Image.Resampling.LANCZOS))


def outlined(model: Any, data: Any, camera: Camera, width: int, height: int) -> Frame:
    """One picture of a MuJoCo model's geoms as outlines, the nearest last; planes are left out."""
    size = SHARPER * width, SHARPER * height
    image = Image.new("RGB", size, "white")
    _draw(ImageDraw.Draw(image), model, data, _surfaces(model, seen_geoms(model)), camera, size)
    return np.asarray(image.resize((width, height), Image.Resampling.LANCZOS))


def camera_around(model: Any, data: Any, width: int, height: int, room: float = 0.0) -> Camera:
    """The camera that sees a MuJoCo model in a pose.

    Args:
        model: MuJoCo's.
        data: its data, with places of geoms.
        width: of the picture [pixel].
        height: [pixel].
        room: how much is to be seen beside, over the size of what is there.
    """
    points = np.concatenate([_corners(model, data, g) for g in seen_geoms(model) if int(model.geom_type[g]) != PLANE])
    middle = (points.max(axis=0) + points.min(axis=0)) / 2
    return camera_for(points, middle + (1 + room) * (points - middle), width, height)


def seen_geoms(model: Any) -> list[int]:
    """Geoms that are seen, planes last."""
    found = [g for g in range(model.ngeom) if model.geom_group[g] < SEEN_GROUPS and _colour(model, g)[3] > 0]
    return sorted(found, key=lambda g: int(model.geom_type[g]) == PLANE)


def _corners(model: Any, data: Any, g: int) -> Array:
    """(8, 3) corners of the box around a geom [m]."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    box = model.geom_aabb[g].reshape(2, 3)
    return np.asarray(data.geom_xpos[g] + (box[0] + corners * box[1]) @ data.geom_xmat[g].reshape(3, 3).T)


def _surfaces(model: Any, geoms: list[int]) -> dict[int, Array]:
    return {g: _surface(model, g) for g in geoms if int(model.geom_type[g]) != PLANE}


def _draw(draw: Any, model: Any, data: Any, surfaces: dict[int, Array], camera: Camera, size: tuple[int, int]) -> None:
    """Outlines of geoms where they are, the nearest last."""
    drawn = []
    for g, local in surfaces.items():
        points = data.geom_xpos[g] + local @ data.geom_xmat[g].reshape(3, 3).T
        places, deep = camera.pixels(points, *size)
        drawn.append((float(deep.mean()), g, places))
    for _, g, places in sorted(drawn, key=lambda one: -one[0]):
        fill = tuple(round(255 * part) for part in _colour(model, g)[:3])
        edge = tuple(round(0.6 * part) for part in fill)
        draw.polygon([tuple(p) for p in _outline(places)], fill=fill, outline=edge)


def _outline(points: Array) -> Array:
    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:  # seen edge-on
        return points


def _surface(model: Any, g: int) -> Array:
    """(n, 3) points whose hull is a geom's, in its own frame [m]."""
    kind, size = int(model.geom_type[g]), model.geom_size[g]
    types = mujoco.mjtGeom
    if kind == int(types.mjGEOM_MESH):
        mesh = int(model.geom_dataid[g])
        first = int(model.mesh_vertadr[mesh])
        points = np.array(model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])], dtype=np.float64)
        return _outline(points)
    turns = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    heights = np.linspace(-np.pi / 2, np.pi / 2, 9)
    flat = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    ball = np.concatenate([np.column_stack([np.cos(h) * flat, np.full(len(flat), np.sin(h))]) for h in heights])
    if kind in (int(types.mjGEOM_SPHERE), int(types.mjGEOM_ELLIPSOID)):
        return np.asarray(ball * (size if kind == int(types.mjGEOM_ELLIPSOID) else size[0]))
    up = np.array([0.0, 0.0, size[1]])
    if kind == int(types.mjGEOM_CAPSULE):
        return np.concatenate([size[0] * ball + up, size[0] * ball - up])
    if kind == int(types.mjGEOM_CYLINDER):
        ring = np.column_stack([size[0] * flat, np.zeros(len(flat))])
        return np.concatenate([ring + up, ring - up])
    box = model.geom_aabb[g].reshape(2, 3)
    return np.array([box[0] + box[1] * np.array([x, y, z]) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
