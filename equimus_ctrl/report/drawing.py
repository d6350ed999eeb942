"""The robot as lines in its plane: where links and actuators are at given angles, and a sketch of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle
from numpy.typing import ArrayLike

from equimus_ctrl.report import style
from equimus_ctrl.robots.elastic.morphology import BASE, Morphology, Phase, Point
from equimus_ctrl.types import Array

MM = 1e3


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Links and actuators in the plane for n poses: x to the right, y down.

    In swing the origin is the base's, in stance it is the pinned foot.

    Attributes:
        links: (n, nj, 2, 2) both ends of the link each joint carries [m].
        actuators: (n, na, 2, 2) origin and insertion of each actuator [m].
        brackets: (n, nb, 2, 2) from a link's axis to an attachment point that lies off it [m].
        base: (n, 2) the base's origin [m].
        foot: (n, 2) the foot [m].
    """

    links: Array
    actuators: Array
    brackets: Array
    base: Array
    foot: Array

    @property
    def points(self) -> Array:
        """(m, 2) all ends of all poses [m]."""
        return np.concatenate([part.reshape(-1, 2) for part in (self.links, self.actuators, self.base)])


def skeleton(morphology: Morphology, angles: ArrayLike, phase: Phase = "swing") -> Skeleton:
    """Where everything is.

    Args:
        morphology: the robot.
        angles: (n, nj) or (nj,) joint angles [rad].
        phase: base fixed or foot pinned.
    """
    q = np.atleast_2d(np.asarray(angles, dtype=np.float64))
    n = len(q)
    frames: dict[str, tuple[Array, Array]] = {BASE: (np.zeros((n, 2)), np.zeros(n))}

    def place(point: Point) -> Array:
        origin, turn = frames[point.body]
        direction = turn + point.angle
        return origin + point.radius * np.stack([np.cos(direction), np.sin(direction)], axis=1)

    links = []
    for i, joint in enumerate(morphology.joints):
        start = place(morphology.joint_point(joint))
        frames[joint.child] = (start, frames[joint.parent][1] + q[:, i])
        links.append(np.stack([start, place(Point(joint.child, morphology.link(joint.child).length))], axis=1))
    actuators = [np.stack([place(a.origin), place(a.insertion)], axis=1) for a in morphology.actuators]
    brackets = [np.stack([place(a), place(b)], axis=1) for a, b in bracket_points(morphology)]
    foot = place(Point(morphology.foot, morphology.link(morphology.foot).length))
    shift = -foot if phase == "stance" else np.zeros((n, 2))
    return Skeleton(
        links=np.stack(links, axis=1) + shift[:, None, None],
        actuators=np.stack(actuators, axis=1) + shift[:, None, None],
        brackets=np.stack(brackets, axis=1) + shift[:, None, None] if brackets else np.empty((n, 0, 2, 2)),
        base=shift,
        foot=foot + shift,
    )


def bracket_points(morphology: Morphology) -> list[tuple[Point, Point]]:
    """(on the link's axis, attachment) for each attachment that lies off its link's axis."""
    found = []
    for point in (end for a in morphology.actuators for end in (a.origin, a.insertion) if end.body != BASE):
        x, y = point.xy
        length = morphology.link(point.body).length
        nearest = min(max(x, 0.0), length)
        if np.hypot(x - nearest, y) > 0.01 * length:
            found.append((Point(point.body, nearest), point))
    return found


def well_spaced(points: Array, count: int) -> list[int]:
    """Indices of up to ``count`` of the points (n, 2), each as far from those before as can be, the first first.

    Points nearer than a tenth of the widest distance found are dropped.
    """
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    widest = float(distance.max())
    while len(chosen) < count:
        best = int(distance.argmax())
        if distance[best] <= max(0.1 * widest, 1e-6):
            break
        chosen.append(best)
        distance = np.minimum(distance, np.linalg.norm(points - points[best], axis=1))
    return chosen


def first_pass(points: Array) -> Array:
    """A path (n, 2) without what it retraces, NaN in the gaps, so that dashes drawn over one another stay dashes."""
    span = float(np.ptp(points, axis=0).max())
    if span == 0:
        return points[:1]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    even = np.linspace(0.0, along[-1], min(int(500 * along[-1] / span) + 2, 20_000))
    dense = np.stack([np.interp(even, along, column) for column in points.T], axis=1)
    cells = np.floor((dense - points.min(axis=0)) / (0.01 * span)).astype(int).tolist()
    last_visit: dict[tuple[int, ...], int] = {}
    kept = dense.copy()
    for k, cell in enumerate(cells):
        earlier = last_visit.get(tuple(cell))
        if earlier is not None and k - earlier > 20:
            kept[k] = np.nan
        else:
            last_visit[tuple(cell)] = k
    return kept


def base_span(morphology: Morphology) -> tuple[float, float]:
    """(left, right) end of the plate to draw for the base, relative to its origin [m]."""
    places = [p.xy[0] for a in morphology.actuators for p in (a.origin, a.insertion) if p.body == BASE]
    places += [morphology.joint_point(j).xy[0] for j in morphology.joints if j.parent == BASE]
    size = sum(link.length for link in morphology.links)
    return min(places) - 0.05 * size, max(places) + 0.05 * size


def sketch(
    axes: Axes, morphology: Morphology, pose: ArrayLike, phase: Phase = "swing", *, strength: float = 1.0
) -> None:
    """Draw the robot at one pose, in mm.

    Args:
        axes: with y pointing down.
        morphology: the robot.
        pose: (nj,) [rad].
        phase: base fixed or foot pinned.
        strength: 1 for the pose in front, less for those behind.
    """
    bones = skeleton(morphology, pose, phase)
    size = sum(link.length for link in morphology.links) * MM
    left, right = (side * MM for side in base_span(morphology))
    x, y = bones.base[0] * MM
    thick = 0.02 * size
    plate = Rectangle((x + left, y - thick), right - left, thick, facecolor=style.FAINT, alpha=strength, linewidth=0)
    axes.add_patch(plate)
    if phase == "stance":
        axes.axhline(0.0, color=style.FAINT, linewidth=2, zorder=0)
    for i, (start, end) in enumerate(bones.actuators[0] * MM):
        colour = style.actuator_colour(i)
        axes.plot(*zip(start, end, strict=True), color=colour, linewidth=5, alpha=strength, solid_capstyle="butt")
    for start, end in bones.brackets[0] * MM:
        axes.plot(*zip(start, end, strict=True), color=style.FAINT, linewidth=2.5, alpha=strength)
    for start, end in bones.links[0] * MM:
        axes.plot(*zip(start, end, strict=True), color=style.INK, linewidth=3, alpha=strength, solid_capstyle="round")
    for spot in (bones.links[0, :, 0] * MM).tolist():
        axes.add_patch(Circle(spot, 0.014 * size, facecolor="white", edgecolor=style.INK, alpha=strength, zorder=3))
    for spot in (bones.actuators[0].reshape(-1, 2) * MM).tolist():
        axes.add_patch(Circle(spot, 0.008 * size, facecolor=style.INK, linewidth=0, alpha=strength, zorder=3))


def label_parts(axes: Axes, morphology: Morphology, pose: ArrayLike, phase: Phase = "swing") -> None:
    """Write the names of joints and actuators beside a sketch at ``pose`` (nj,) [rad]."""
    bones = skeleton(morphology, pose, phase)
    middle = bones.points.mean(axis=0) * MM
    boxed = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
    for i, (start, end) in enumerate(bones.actuators[0] * MM):
        at = start + (0.2 + 0.12 * (i % 3)) * (end - start)
        axes.annotate(
            morphology.actuator_names[i],
            at,
            xytext=(14 if at[0] >= middle[0] else -14, 0),
            textcoords="offset points",
            ha="left" if at[0] >= middle[0] else "right",
            va="center",
            fontsize=style.TEXT_SIZE,
            color=style.actuator_colour(i),
            fontweight="bold",
            bbox=boxed,
            zorder=6,
        )
    for i, spot in enumerate(bones.links[0, :, 0] * MM):
        axes.annotate(
            morphology.joint_names[i],
            spot,
            xytext=(9, -9),
            textcoords="offset points",
            fontsize=style.TEXT_SIZE,
            color=style.joint_colour(i),
            fontweight="bold",
            bbox=boxed,
            zorder=6,
        )
