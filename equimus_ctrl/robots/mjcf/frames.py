"""The frames in which a tree's links are described: any that move with them will do, and some make equations short.

A link's frame has its joint's third axis; where its origin lies along that axis and how it is turned about it is free.
As in the parameters of Denavit and Hartenberg (Khalil & Kleinfinger, "A new geometric notation for open and closed-loop
robots", 1986) a frame's first axis is the common normal to the axis of a child, so that the child's frame, its joint at
its reference, is turned against it about that normal alone; the child's origin lies on the normal. Where a joint's
reference is moves with that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.robots.mjcf.form import LinkForm, Vector
from equimus_ctrl.types import Array

DUST = 1e-14
"""Entries of directions that are rounding errors."""
Frame = tuple[int, Array, Array]
"""Link, place and axes in the link's frame of a body's frame."""


def snapped(values: Array) -> Vector:
    """Flat, with rounding errors around 0 and ±1 taken off, so that generated code leaves those terms out."""
    flat = np.array(values, dtype=np.float64).ravel()
    for whole in (0.0, 1.0, -1.0):
        flat[np.abs(flat - whole) < DUST] = whole
    return tuple(float(v) for v in flat)


def shortened(links: Sequence[LinkForm], frames: Sequence[Frame]) -> tuple[tuple[LinkForm, ...], list[Frame]]:
    """The same links and bodies' frames, described in frames that make equations short.

    Args:
        links: parents before children.
        frames: of the bodies.
    """
    reach = sum(float(np.linalg.norm(link.place)) for link in links)
    moved: list[_Moved] = []
    found: list[LinkForm] = []
    for i, link in enumerate(links):
        axes, place = np.array(link.turn).reshape(3, 3), np.array(link.place)
        if link.parent >= 0:
            parent = moved[link.parent]
            axes, place = parent.axes.T @ axes, parent.axes.T @ (place - parent.origin)
        child = _child(links, i)
        shift = np.zeros(3)
        if link.slides and link.parent >= 0:
            shift = -axes.T @ place
        elif link.parent >= 0:
            shift[2] = _along(axes[:, 2], place, reach)
        elif child is not None and not link.slides:
            # Nothing hangs on where the base is: its origin is where the first child's normal begins.
            shift[2] = _begin(np.array(child.turn)[[2, 5, 8]], np.array(child.place), reach)
        straight = _straight(axes)
        spin = straight if child is None or link.slides else _towards(child)
        # A joint that turns is where it was at another value of its coordinate.
        turn = axes @ _about_z(straight)
        reference = link.reference if link.slides else link.reference + _wrapped(straight - spin)
        moved.append(_Moved(shift, _about_z(spin)))
        found.append(replace(link, place=snapped(place + axes @ shift), turn=snapped(turn), reference=reference))
    bodies = [
        (link, place, turn)
        if link < 0
        else (link, moved[link].axes.T @ (place - moved[link].origin), moved[link].axes.T @ turn)
        for link, place, turn in frames
    ]
    return tuple(found), bodies


@dataclass(frozen=True, eq=False)
class _Moved:
    """Where a link's new frame is in its old one."""

    origin: Array
    axes: Array


def _child(links: Sequence[LinkForm], i: int) -> LinkForm | None:
    """The link that a link's frame is turned for: of those that hang on it the first whose axis is not parallel."""
    own = [link for link in links if link.parent == i]
    oblique = (link for link in own if np.hypot(link.turn[2], link.turn[5]) > DUST)
    return next(oblique, own[0] if own else None)


def _towards(child: LinkForm) -> float:
    """Angle about its third axis from a link's first axis to the common normal with a child's axis."""
    x, y = child.turn[2], child.turn[5]
    if np.hypot(x, y) > DUST:
        return float(np.arctan2(x, -y))
    return float(np.arctan2(child.place[1], child.place[0])) if any(child.place[:2]) else 0.0


def _along(z: Array, place: Array, reach: float) -> float:
    """How far along a joint's axis from its origin the common normal with the parent's third axis is; 0 if far away."""
    flat = float(z[0] ** 2 + z[1] ** 2)
    shift = -float(place[2] / z[2]) if flat < DUST**2 else -float(z[:2] @ place[:2]) / flat
    return shift if abs(shift) <= reach else 0.0


def _begin(z: Array, place: Array, reach: float) -> float:
    """How far along its own third axis from its origin a link's common normal with a child's axis begins."""
    flat = float(z[0] ** 2 + z[1] ** 2)
    shift = float(place[2]) if flat < DUST**2 else float(place[2] - z[2] * (z[:2] @ place[:2]) / flat)
    return shift if abs(shift) <= reach else 0.0


def _straight(axes: Array) -> float:
    """Angle by which axes are turned about their third so that they are turned about the parent's first alone.

    Where that cannot be, so that their first has no part along the parent's third.
    """
    if abs(axes[0, 2]) < DUST:
        return float(np.arctan2(axes[0, 1], axes[0, 0]))
    return float(np.arctan2(-axes[2, 0], axes[2, 1]))


def _about_z(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _wrapped(angle: float) -> float:
    return float(np.remainder(angle + np.pi, 2 * np.pi) - np.pi)
