"""What forces along a motion change of all that is compared: joint positions, and channels beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.engines.base import ForceResponse
from equimus_ctrl.engines.motion import Motion
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class ObservedResponse:
    """A ``ForceResponse`` of all outputs of some segments.

    Attributes:
        inside: of the joints' positions.
        robot: what moves.
        segments: whose channels count.
    """

    inside: ForceResponse
    robot: Robot
    segments: Sequence[Segment]

    @property
    def motions(self) -> tuple[Motion, ...]:
        """One for each trial."""
        return self.inside.motions

    def response(self, torques: Sequence[Array]) -> list[Array]:
        """For each trial (m, nj + ne, k), see ``ForceResponse.response`` and ``Channels.changes``."""
        shown, inner = self.inside.response(torques), self.inner_response(torques)
        forced = any(segment.channels.forces for segment in self.segments)
        drives = self.drive_response(torques) if forced else [np.empty((len(c), 0, c.shape[2])) for c in inner]
        found = []
        parts = zip(self.segments, self.motions, shown, inner, drives, strict=True)
        for segment, motion, joints, change, forces in parts:
            whole = np.column_stack([motion.position, motion.velocity])
            more = segment.channels.changes(self.robot, whole, change, forces, segment.trial.moved)
            found.append(np.concatenate([joints, more], axis=1))
        return found

    def inner_response(self, torques: Sequence[Array]) -> list[Array]:
        """The same (m, 2 nj, k) of the true positions and rates."""
        return self.inside.inner_response(torques)

    def drive_response(self, torques: Sequence[Array]) -> list[Array]:
        """The same (m, na, k) of the drives' forces."""
        return self.inside.drive_response(torques)


def observed(inside: ForceResponse, robot: Robot, segments: Sequence[Segment]) -> ForceResponse:
    """A response of all outputs of some segments; as it is where joints' positions are all there is."""
    return ObservedResponse(inside, robot, segments) if any(s.channels for s in segments) else inside
