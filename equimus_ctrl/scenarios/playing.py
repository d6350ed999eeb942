"""Commands that are played from a file: where the robot begins, and what it is compared with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from equimus_ctrl.controllers.tracking import TrackingController
from equimus_ctrl.engines.predict import robot_as_noted
from equimus_ctrl.engines.rest import rest_pose, rest_poses
from equimus_ctrl.errors import ConfigError, ModelError, NotAvailable
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings.commands import CommandFile
from equimus_ctrl.scenarios.context import CommandProfile, ScenarioContext, out_of_range
from equimus_ctrl.scenarios.references import HoldReference, SampledReference
from equimus_ctrl.types import Array, Reference


def in_its_condition(context: ScenarioContext, file: str, own: CommandFile) -> ScenarioContext:
    """The context of the robot with what a file's notes say is known to be different, see ``engines.predict.noted``."""
    return replace(context, robot=robot_as_noted(context.robot, file, own.different)) if own.different else context


def begins(context: ScenarioContext, file: str, own: CommandFile) -> Array:
    """(nj,) where the robot begins with commands of a file [rad or m].

    Raises:
        ConfigError: where it rests nowhere under the command before the first row, or a pose that is given is out of
            its range.
    """
    if own.position is not None:
        if outside := out_of_range(context.robot, own.position):
            raise ConfigError(f"{file}: the robot begins with {outside}")
        return own.position
    try:
        return rest_pose(Model(context.robot, context.effects, context.phase), own.before)
    except (ModelError, NotAvailable) as error:
        raise ConfigError(
            f"{file}: {error}; expected a first command under which it rests, or notes start.pos.JOINT that say where "
            "it begins"
        ) from None


def tracked(own: CommandFile) -> TrackingController | None:
    """What has joints track the reference of a file; None where commands are played as they are."""
    if own.law is None or own.reference is None:
        return None
    return TrackingController(
        own.law, SampledReference(own.times, own.reference), SampledReference(own.times, own.values)
    )  # fmt: skip


def resting(context: ScenarioContext, profile: CommandProfile, first: Array, most: int) -> Reference:
    """Where the robot would rest under each command, within its ranges; where it begins if it rests under none of one.

    Args:
        context: of the robot.
        profile: the commands.
        first: (nj,) where it begins [rad or m].
        most: instants at which it is worked out.
    """
    model = Model(context.robot, context.effects, context.phase)
    times = profile.times[np.unique(np.linspace(0, len(profile.times) - 1, most).astype(int))]
    try:
        later = rest_poses(model, [profile.at(float(time)) for time in times[1:]], first)
    except (ModelError, NotAvailable):
        return HoldReference(np.clip(first, *context.robot.joint_range))
    return SampledReference(times, np.clip(np.vstack([first, later]), *context.robot.joint_range))
