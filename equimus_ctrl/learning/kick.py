"""The kick: a ball before the robot, a target, and how well the one is sent towards the other."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.errors import ConfigError, EquimusError
from equimus_ctrl.learning.observing import Scaling, TimeLeft
from equimus_ctrl.learning.settings import KickSettings
from equimus_ctrl.learning.tasks import Rows, Task
from equimus_ctrl.models.ball import BALL, TOUCH, add_ball
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.points import points_of
from equimus_ctrl.plants.batch import BatchPlant, Finish, Step
from equimus_ctrl.plants.batch_group import Group
from equimus_ctrl.types import Array, Start

AIM = 10.0
"""A ball that flies no farther off has hit the target [°]."""


class KickScore:
    """How well balls are kicked, by their linear velocity v and the unit vector d towards the target.

    The score of an instant is v·d − |v − (v·d)d|: what flies beside the target counts against what flies towards it, so
    10° off cost a fifth. That of a kick is the best so far, 0 where the ball never moves towards the target.

    Args:
        n: how many balls.
        direction: (3,) d.

    Attributes:
        best: (n,) scores [m/s].
        speed: (n,) v·d at the best instant [m/s].
        miss: (n,) angle between v and d then [rad]; π where the ball never moved towards the target.
        force: (n,) greatest force between ball and kicker [N].
    """

    def __init__(self, n: int, direction: Array) -> None:
        self._direction = direction
        self.best, self.speed, self.miss, self.force = np.zeros((4, n))

    def begin(self, row: int) -> None:
        """Nothing has happened yet."""
        self.best[row] = self.speed[row] = self.force[row] = 0.0
        self.miss[row] = np.pi

    def add(self, rows: Rows, velocity: Array, force: Array) -> None:
        """What happened at instants, in their order.

        Args:
            rows: of which balls.
            velocity: (r, k, 3) [m/s].
            force: (r, k, 3) of the kicker on the ball [N].
        """
        towards = velocity @ self._direction
        aside = np.linalg.norm(velocity - towards[..., None] * self._direction, axis=2)
        scores = towards - aside
        at = scores.argmax(axis=1)
        own = np.arange(len(rows))
        better = scores[own, at] > self.best[rows]
        chosen, some = rows[better], at[better]
        self.best[chosen] = scores[better, some]
        self.speed[chosen] = towards[better, some]
        self.miss[chosen] = np.arctan2(aside[better, some], towards[better, some])
        self.force[rows] = np.maximum(self.force[rows], np.linalg.norm(force, axis=2).max(axis=1))


class Kick(Task):
    """Kick a ball towards a target.

    The reward of a control period is by how much the score (``KickScore``) rose in it, so that an episode's return is
    the kick's score in m/s. It is over where the ball has gone.

    Args:
        model: the nominal one, that says where the ball lies.
        settings: see ``KickSettings``.

    Raises:
        ConfigError: where nobody says what kicks, or where the ball lies.
    """

    finite = True

    def __init__(self, model: Model, settings: KickSettings) -> None:
        super().__init__("kick", settings.duration)
        self._settings = settings
        self.seen_size = 3 if settings.seen else 0
        self.blind = "where the ball is" if settings.seen else ""
        points = points_of(model)
        if not settings.kicker and not points.ends:
            raise ConfigError(f"{model.name}: nothing of it sticks out to kick with, expected the kicker's name")
        self.kicker = settings.kicker or points.ends[0]
        angle = np.radians(settings.direction)
        self.direction = np.array([np.cos(angle), np.sin(angle), 0.0])
        self.place = np.array(self._before(model) if settings.place is None else settings.place)
        self.scene = partial(add_ball, place=self.place.tolist(), kicker=self.kicker, ball=settings.ball)

    def _before(self, model: Model) -> Array:
        """(3,) before the kicker while the robot rests under the middle of its commands [m]."""
        points, settings = points_of(model), self._settings
        if self.kicker not in points.names:
            raise ConfigError(f"{model.name}: {self.kicker!r} is no site or body, known are {', '.join(points.names)}")
        low, high = model.robot.command_limits
        if not np.isfinite([low, high]).all():
            raise ConfigError(f"{model.name}: some commands have no limits and so no middle; expected the ball's place")
        try:
            pose = rest_pose(model, (low + high) / 2)
        except EquimusError as error:
            raise ConfigError(f"{error}; expected the ball's place") from None
        x, y, z = points.at(self.kicker, pose)[0]
        foot = np.array([x, z, -y] if points.y_down else [x, y, z])
        return np.asarray(foot + (settings.ball.radius + settings.gap) * self.direction)

    def prepare(self, plant: BatchPlant, scaling: Scaling) -> None:
        """As of any task."""
        self.score = KickScore(plant.n, self.direction)
        self._ball, self._velocity = np.tile(self.place, (plant.n, 1)), np.zeros((plant.n, 3))
        self._lay = self._ball.copy()
        self._time = TimeLeft(plant.longest)
        self.sight = None if self._settings.seen else self._time
        self._known: dict[Group, tuple[int, int, int]] = {}

    @property
    def size(self) -> int:
        """As of any task."""
        return self.seen_size + 1

    @property
    def hidden_size(self) -> int:
        """As of any task."""
        return 3

    def begin(self, row: int, rng: np.random.Generator) -> tuple[Start, Finish | None]:
        """At rest, the ball in its place or scattered about it."""
        self.score.begin(row)
        aside = self._settings.scatter * rng.uniform(-1.0, 1.0) if self._settings.scatter else 0.0
        self._ball[row] = self._lay[row] = self.place + aside * self.direction
        self._velocity[row] = 0.0
        return Start(), partial(_lay, place=self._lay[row].copy())

    def observed(self, rows: Rows, periods: NDArray[np.int64], noise: Array) -> Array:
        """Where the ball is seen from its usual place, over the way after which it has gone; and the time left."""
        left = self._time.left(periods)[:, None]
        if not self._settings.seen:
            return np.asarray(left)
        return np.hstack([(self._ball[rows] + noise - self.place) / self._settings.gone, left])

    def hidden(self, rows: Rows) -> Array:
        """The ball's velocity [m/s]."""
        return self._velocity[rows]

    def judge(self, rows: Rows, periods: NDArray[np.int64], steps: list[Step]) -> tuple[Array, NDArray[np.bool_]]:
        """As of any task."""
        before = self.score.best[rows]
        for step in steps:
            own, moved = step.rows[step.moved.sound], step.moved
            q, v, force = (
                values[moved.sound][:, :, first : first + 3]
                for values, first in zip((moved.qpos, moved.qvel, moved.sensors), self._places(step.group), strict=True)
            )
            self._ball[own], self._velocity[own] = q[:, -1], v[:, -1]
            self.score.add(own, v, force)
        away = np.linalg.norm(self._ball[rows] - self._lay[rows], axis=1)
        return self.score.best[rows] - before, away > self._settings.gone

    def _places(self, group: Group) -> tuple[int, int, int]:
        """Where the ball is in qpos, in qvel, and the force in the sensors' data."""
        if group not in self._known:
            joint, touch = group.base.joint(BALL), group.base.sensor(TOUCH)
            self._known[group] = int(joint.qposadr[0]), int(joint.dofadr[0]), int(touch.adr[0])
        return self._known[group]

    def success(self, info: Mapping[str, Array]) -> NDArray[np.bool_]:
        """Whether balls flew within ``AIM`` of the target."""
        return np.asarray((info["ball_speed"] > 0) & (info["miss_angle"] <= AIM))

    def info(self, rows: Rows) -> dict[str, Array]:
        """``ball_speed`` towards the target [m/s], ``miss_angle`` [°] and ``kick_force`` [N]."""
        own = self.score
        return {
            "ball_speed": own.speed[rows], "miss_angle": np.degrees(own.miss[rows]), "kick_force": own.force[rows],
        }  # fmt: skip


def _lay(model: Any, data: Any, place: Array) -> None:
    first = int(model.joint(BALL).qposadr[0])
    data.qpos[first : first + 7] = (*place, 1.0, 0.0, 0.0, 0.0)
