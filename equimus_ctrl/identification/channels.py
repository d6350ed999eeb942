"""What is compared with a model beside joint positions: velocities of joints, forces of drives, coordinates of sites.

They are measured by other means than the positions: offset, scale, delay and play of a joint's sensor are not theirs.
Each has noise of its own. A drive's force is what its actuator exerts by the model, before the gear: MuJoCo's
``actuator_force``, at the instant of the row and under the row's own command as it has arrived by then.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.engines.mjcf_sites import site_names, site_positions, unmeasured_sites
from equimus_ctrl.engines.trials import Predicted
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.mjcf.entries import Drive
from equimus_ctrl.robots.mjcf.robot import mjcf_of
from equimus_ctrl.types import Array, Recording

ALSO = "also"
"""Note of a recording that lists what of it is compared beside joint positions: ``also = vel.elbow site.tip.x``."""
SMALL = 1e-6
"""Step of the differences of sites' positions [rad or m]."""
VELOCITY, FORCE, SITE, AXES = "vel.", "meas.", "site.", "xyz"


@dataclass(frozen=True)
class Channels:
    """What is compared beside joint positions.

    Attributes:
        velocities: of joints, by their places.
        sites: names and axes of sites' coordinates.
        forces: of drives, by the places of their commands.
    """

    velocities: tuple[int, ...] = ()
    sites: tuple[tuple[str, int], ...] = ()
    forces: tuple[int, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.velocities or self.sites or self.forces)

    def names(self, robot: Robot) -> tuple[str, ...]:
        """As the recordings' columns have them."""
        sites = (f"{SITE}{name}.{AXES[axis]}" for name, axis in self.sites)
        velocities = (VELOCITY + robot.joint_names[j] for j in self.velocities)
        return (*velocities, *sites, *(FORCE + robot.actuator_names[i] for i in self.forces))

    def units(self, robot: Robot) -> tuple[str, ...]:
        """Of each."""
        velocities = ("m/s" if robot.slides(robot.joint_names[j]) else "rad/s" for j in self.velocities)
        forces = ("N·m" if d.at_joint and not robot.slides(d.joint) else "N" for d in self._drives(robot))
        return (*velocities, *("m" for _ in self.sites), *forces)

    def joints(self, robot: Robot) -> tuple[int | None, ...]:
        """The joint that each tells of, as an index: its own, or the one that its drive drives; None for a site."""
        driven = (robot.joint_names.index(drive.joint) for drive in self._drives(robot))
        return (*self.velocities, *(None for _ in self.sites), *driven)

    def _drives(self, robot: Robot) -> list[Drive]:
        return [mjcf_of(robot).actuators[i] for i in self.forces]

    def of_motion(self, robot: Robot, motion: Array, moved: Array | None = None) -> Array:
        """(k, m, ne) what velocities and sites would be in motions (k, m, 2 nj) of a robot's joints.

        Args:
            robot: whose.
            motion: positions and rates.
            moved: (m, np) of joints whose motion is prescribed, see ``Trial.moved``.
        """
        nj = motion.shape[2] // 2
        names = list(dict.fromkeys(name for name, _ in self.sites))
        rates = motion[:, :, [nj + j for j in self.velocities]]
        if not names:
            return rates
        where = site_positions(mjcf_of(robot), motion[:, :, :nj], names, moved)
        columns = [where[:, :, names.index(name), axis] for name, axis in self.sites]
        return np.concatenate([rates, np.stack(columns, axis=-1)], axis=2)

    def changes(self, robot: Robot, motion: Array, change: Array, forces: Array, moved: Array | None = None) -> Array:
        """(m, ne, k) changes of these by small changes (m, 2 nj, k) of a motion (m, 2 nj), to first order.

        Args:
            robot: what moves.
            motion: its joints' positions and rates.
            change: of them.
            forces: (m, na, k) changes of the drives' forces; without entries where none is compared.
            moved: see ``of_motion``.
        """
        nj = motion.shape[1] // 2
        rates, driven = change[:, [nj + j for j in self.velocities]], forces[:, list(self.forces)]
        if not self.sites:
            return np.concatenate([rates, driven], axis=1)
        shifted = np.repeat(motion[None], nj + 1, axis=0)
        shifted[1:, :, :nj] += SMALL * np.eye(nj)[:, None]
        where = replace(self, velocities=()).of_motion(robot, shifted, moved)
        slopes = (where[1:] - where[0]) / SMALL  # (nj, m, ns)
        return np.concatenate([rates, np.einsum("jms,mjk->msk", slopes, change[:, :nj]), driven], axis=1)

    def added(self, robot: Robot, found: Predicted, moved: Array | None = None) -> Predicted:
        """Predictions with these beside the joints' positions, see ``of_motion``."""
        assert found.motion is not None  # trials with channels ask for it
        more = [self.of_motion(robot, found.motion, moved)]
        if self.forces:
            assert found.forces is not None
            more.append(found.forces[:, :, list(self.forces)])
        return replace(found, position=np.concatenate([found.position, *more], axis=2))


NOTHING = Channels()


def channels_of(model: Model, recording: Recording) -> Channels:
    """What a recording's note ``also`` lists.

    Raises:
        ConfigError: for what is not recorded, what the robot does not have, or a robot that MuJoCo's XML does not
            describe.
    """
    words = recording.notes.get(ALSO, "").split()
    if not words:
        return NOTHING
    if model.robot.traits.starts_at_rest:
        raise ConfigError(f"{recording.name}: note {ALSO!r} is for MJCF robots alone")
    known = recorded_columns(recording)
    for word in words:
        if word not in known:
            raise ConfigError(unknown_name("column", word, known, f"{recording.name}: note {ALSO}"))
    velocities = [j for j, joint in enumerate(recording.joints) if VELOCITY + joint in words]
    forces = [i for i, name in enumerate(recording.actuators) if FORCE + name in words]
    sites = [word.removeprefix(SITE) for word in known if word in words and word.startswith(SITE)]
    there = site_names(mjcf_of(model.robot)) if sites else ()
    parts = [name.rpartition(".") for name in sites]
    for name, _, _ in parts:
        if name not in there:
            raise ConfigError(unknown_name("site", name, there, f"{recording.name}: column {SITE}{name}"))
    if loose := [name for name, _, _ in parts if name in unmeasured_sites(mjcf_of(model.robot))]:
        raise ConfigError(
            f"{recording.name}: site {loose[0]} is moved by joints that are not measured, expected one that only "
            "measured or prescribed joints move"
        )
    return Channels(tuple(velocities), tuple((name, AXES.index(axis)) for name, _, axis in parts), tuple(forces))


def require_alike(channels: Sequence[Channels], names: Sequence[str]) -> None:
    """Raise ConfigError unless the same is compared in all recordings, which have these names."""
    for name, own in zip(names, channels, strict=True):
        if own != channels[0]:
            raise ConfigError(
                f"{name} and {names[0]} do not compare the same columns beside joint positions; expected all "
                "recordings to have them"
            )


def recorded_columns(recording: Recording) -> tuple[str, ...]:
    """What of a recording could be compared beside joint positions."""
    rates = () if recording.velocity is None else tuple(VELOCITY + joint for joint in recording.joints)
    forces = tuple(FORCE + recording.actuators[i] for i in recording.force_columns)
    return (*rates, *(SITE + name for name in recording.sites), *forces)


def unused(recordings: Sequence[Recording]) -> list[str]:
    """Columns of recordings that could be compared beside joint positions, and are not listed."""
    found: dict[str, None] = {}
    for recording in recordings:
        listed = recording.notes.get(ALSO, "").split()
        found |= dict.fromkeys(name for name in recorded_columns(recording) if name not in listed)
    return list(found)


def measured_channels(channels: Channels, recording: Recording) -> Array:
    """(n, ne) what was measured."""
    rates = np.empty((len(recording.time), 0))
    if recording.velocity is not None:
        rates = recording.velocity[:, list(channels.velocities)]
    sites = [recording.sites[f"{name}.{AXES[axis]}"] for name, axis in channels.sites]
    forces = [] if recording.measured is None else list(recording.measured[:, list(channels.forces)].T)
    return np.column_stack([rates, *sites, *forces])


def with_channels(trials: Sequence[Recording], patterns: Sequence[str]) -> list[Recording]:
    """Trials with a note of those columns, by names or patterns, that are compared beside joint positions.

    Raises:
        ConfigError: for a pattern that fits none of a trial's.
    """
    marked = []
    for trial in trials:
        known = recorded_columns(trial)
        for pattern in patterns:
            if not fnmatch.filter(known, pattern):
                raise ConfigError(unknown_name("column", pattern, known, f"{trial.name}: to compare beside positions"))
        chosen = [name for name in known if any(fnmatch.fnmatchcase(name, p) for p in patterns)]
        marked.append(replace(trial, notes={**trial.notes, ALSO: " ".join(chosen)}) if chosen else trial)
    return marked
