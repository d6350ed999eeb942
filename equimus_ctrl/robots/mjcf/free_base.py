"""A free base whose pose was measured: three slides along the room's axes and three hinges take its free joint's place.

The body's rotation is R = R₁(α) R₂(β) R₃(γ) about three of its own axes in turn (Tait–Bryan angles). Where |β| nears
90° α and γ are not distinguishable (gimbal lock), so the sequence of axes is chosen by the recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.types import Array

POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
"""What is recorded of a base: its position in the room [m], its orientation as a unit quaternion in MuJoCo's order."""
SEQUENCES = ("zyx", "xyz", "yzx", "zxy", "yxz", "xzy")
"""Axes in turn, the first the one that is preferred: yaw, pitch, roll."""
USUAL, MOST = np.radians(60.0), np.radians(80.0)
"""Up to USUAL the second angle is as good as any [rad]; beyond MOST the others are as much as six times as uncertain as
the orientation."""
UNIT = 0.01
"""A quaternion's norm may differ from 1 by as much, by rounding."""


def columns_of(base: str) -> tuple[str, ...]:
    """The positions that are recorded of a base."""
    return tuple(f"{base}.{part}" for part in POSE)


def joints_of(base: str, sequence: str) -> tuple[str, ...]:
    """The joints that take the place of its free joint."""
    return (*(f"{base}.{axis}" for axis in "xyz"), *(f"{base}.turn_{axis}" for axis in sequence))


def free_joints(spec: Any) -> tuple[str, ...]:
    """Names of the free joints of MuJoCo's specification."""
    return tuple(own.name for own in spec.joints if own.type == mujoco.mjtJoint.mjJNT_FREE)


def part(spec: Any, base: str, sequence: str) -> tuple[str, ...]:
    """Put slides and hinges in the place of a free joint in a specification; their names."""
    joint = spec.joint(base)
    body = joint.parent
    spec.delete(joint)
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.pos, body.quat = _turned_back(spec, body)
    names = joints_of(base, sequence)
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    for name, axis, kind in zip(names, "xyz" + sequence, [slide] * 3 + [hinge] * 3, strict=True):
        own = body.add_joint(name=name, type=kind, axis=[float(axis == other) for other in "xyz"], pos=[0.0] * 3)
        own.ref = own.springref = 0.0
    return names


def _turned_back(spec: Any, body: Any) -> tuple[Array, Array]:
    """(position, quaternion) with which a body is at the room's origin, along its axes, whatever frame it is in."""
    body.pos, body.quat = [0.0] * 3, [1.0, 0.0, 0.0, 0.0]
    model, place, turn = spec.compile(), np.empty(3), np.empty(4)
    mujoco.mju_negPose(place, turn, model.body_pos[body.id], model.body_quat[body.id])
    return place, turn


def positions(where: str, base: str, sequence: str, pose: Array) -> Array:
    """(n, 6) positions of a base's slides and hinges [m, rad], angles without jumps.

    Either sign of a quaternion is the same orientation.

    Args:
        where: the recording's name, for messages.
        base: name of its free joint.
        sequence: of the hinges' axes.
        pose: (n, 7) as ``POSE`` says.

    Raises:
        ConfigError: where a quaternion is no unit one, or the second angle comes near to gimbal lock.
    """
    angles = _angles(where, base, sequence, pose)
    if (most := np.abs(angles[:, 1]).max()) > MOST:
        row = int(np.argmax(np.abs(angles[:, 1])))
        raise ConfigError(
            f"{where}: sample {row} of {base}: the second of the angles about {', '.join(sequence)} is "
            f"{np.degrees(most):.0f}°, expected {np.degrees(MOST):.0f}° at most; no sequence of axes stays clear of "
            "gimbal lock in these recordings, or the model was read without them"
        )
    return np.column_stack([pose[:, :3], np.unwrap(angles, axis=0)])


def sequence_for(base: str, poses: Sequence[tuple[str, Array]]) -> str:
    """The sequence of axes that stays clear of gimbal lock in some recordings, or the one that comes least near to it.

    Args:
        base: name of the free joint.
        poses: each recording's name, and (n, 7) its pose.

    Raises:
        ConfigError: where a quaternion is no unit one.
    """
    nearest = {}
    for sequence in SEQUENCES:
        nearest[sequence] = max(float(np.abs(_angles(name, base, sequence, pose)[:, 1]).max()) for name, pose in poses)
        if nearest[sequence] <= USUAL:
            return sequence
    return min(nearest, key=lambda own: nearest[own])


def _angles(where: str, base: str, sequence: str, pose: Array) -> Array:
    """(n, 3) Tait–Bryan angles [rad]."""
    norm = np.linalg.norm(pose[:, 3:], axis=1)
    if (wrong := np.abs(norm - 1) > UNIT).any():
        row = int(np.argmax(wrong))
        raise ConfigError(
            f"{where}: sample {row} of pos.{base}.qw, .qx, .qy, .qz: the quaternion {pose[row, 3:].tolist()} has the "
            f"norm {norm[row]:.4g}, expected 1, with its real part first"
        )
    turn = Rotation.from_quat(pose[:, [4, 5, 6, 3]])
    return np.asarray(turn.as_euler(sequence.upper(), suppress_warnings=True))
