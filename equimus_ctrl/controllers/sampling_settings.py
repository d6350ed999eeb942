"""Settings of the sampling controller, for every robot alike; what is 0 or ``"auto"`` is as is usual for its plans.

Plans are of two kinds, and the robot says which. Where its joints can follow a path, because each has an actuator or
springs hold it, plans are what is commanded beyond that path's own commands (``controllers.sampling``). Where some
joint has none, something touches as it begins, or no equations of motion hold the robot, plans look where they lead
(``controllers.sampling_policies``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from equimus_ctrl.controllers.allowances import settable
from equimus_ctrl.controllers.horizon import HorizonSettings
from equimus_ctrl.engines.contacts import touching
from equimus_ctrl.errors import ConfigError, NotAvailable, unknown_name
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model
from equimus_ctrl.predictive.forward import ENGINES
from equimus_ctrl.predictive.sampling import METHODS
from equimus_ctrl.predictive.splines import Spline
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.mjcf.robot import mjcf_of
from equimus_ctrl.settings import FileSettings, setting
from equimus_ctrl.types import Array

FORMAT = "equimus-ctrl/sampling/2"
FOLLOWS = "robots whose joints can follow a path"
LOOKS = "robots with a joint without actuator, in contact or without equations of motion"
"""What some settings are for, as of the two kinds of plans."""


@dataclass(frozen=True)
class Usual:
    """What is usual for one kind of plans, see ``SamplingSettings``."""

    method: str
    samples: int
    horizon: float
    knots: int
    least_deviation: float
    deviation: float


USUAL = {
    FOLLOWS: Usual("cem", 32, 1 / 3, 4, 0.0012, 0.24),
    LOOKS: Usual("predictive_sampling", 128, 0.0, 0, 0.01, 1.0),
}


@dataclass(frozen=True)
class SamplingSettings(HorizonSettings, FileSettings):
    """Settings of the sampling controller, beside what a ``HorizonSettings`` allows.

    Attributes:
        method: of ``predictive.sampling.METHODS``, or ``"auto"``: the cross-entropy method along a path, else
            predictive sampling.
        samples: plans tried at once, the nominal one included; 0 for 32 along a path, else 128.
        horizon: how far plans look ahead [s]; 0 for a third of a second along a path, else a period of the slowest
            motion about the wanted pose.
        stride: how many control periods each step along a path lasts.
        knots: of a plan's spline; 0 for four along a path, else four in a period of the fastest motion.
        spline: ``"zero"`` (each knot holds until the next), ``"linear"`` or ``"cubic"``.
        least_deviation: standard deviation of the knots of the finest plans, in half the range of commands; 0 for
            0.0012 along a path, else 0.01.
        deviation: of the boldest; 0 for 0.24 along a path, else 1.
        temperature: of MPPI, relative to the difference between the median and the least cost of the plans.
        elites: share of the plans that the cross-entropy method goes on with.
        iterations: rounds of samples at one instant, at most.
        every: how many control periods a plan that looks where it leads is followed before others are tried.
        engine: ``"exact"`` (equations of motion in machine code), ``"mujoco"`` or ``"auto"``.
        ensemble: how many models each plan along a path is tried on: the model, and others with perturbed parameters.
        spread: by which share their parameters are perturbed at most.
        risk: share of the models that counts, those on which a plan costs most; 1 for the mean over all.
        effort: what a command off by half its range costs beside an error of half a joint's range.
        energy: what energy off by all that poses differ by costs beside the same.
        unexplained: accelerations that the model does not explain, in shares of the largest that the actuators exert.
        seed: of all that is drawn.

    Raises:
        ConfigError: for numbers that make no sense.
    """

    form: ClassVar[str] = FORMAT

    angle: float = setting(0.03, FOLLOWS)
    limit: float = setting(0.003, FOLLOWS)
    margin: float = setting(0.0, FOLLOWS)
    deadline: float = setting(0.0, FOLLOWS)
    disturbance: bool = setting(True, FOLLOWS)
    estimate_valves: bool = setting(True, FOLLOWS)
    spacing: float = setting(0.2, FOLLOWS)
    start_time: float = setting(0.3, FOLLOWS)
    method: str = "auto"
    samples: int = 0
    horizon: float = 0.0
    stride: int = setting(1, FOLLOWS)
    knots: int = 0
    spline: str = "linear"
    least_deviation: float = 0.0
    deviation: float = 0.0
    temperature: float = setting(0.1, "method mppi")
    elites: float = setting(0.1, "method cem")
    iterations: int = 1
    every: int = setting(2, LOOKS)
    engine: str = "auto"
    ensemble: int = setting(1, FOLLOWS)
    spread: float = setting(0.15, FOLLOWS)
    risk: float = setting(1.0, FOLLOWS)
    effort: float = setting(0.1, LOOKS)
    energy: float = setting(4.0, LOOKS)
    unexplained: float = setting(0.002, LOOKS)
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method not in ("auto", *METHODS):
            raise ConfigError(unknown_name("method", self.method, ("auto", *METHODS)))
        if self.engine not in ENGINES:
            raise ConfigError(f"engine is {self.engine!r}, expected one of {', '.join(ENGINES)}")
        for key, least, most in (
            ("stride", 1, 100), ("knots", 0, 1000), ("iterations", 1, 1000), ("every", 1, 1000), ("ensemble", 1, 1000),
            ("seed", 0, 2**63),
        ):  # fmt: skip
            self._count(key, least, most)
        if self.samples and not 4 <= self.samples <= 100_000:
            raise ConfigError(f"samples is {self.samples}, expected 4 to 100000, or 0 for what is usual")
        self._require(("temperature", "elites", "risk", "effort", "unexplained"), above=0.0)
        self._require(("horizon", "least_deviation", "spread", "energy"), least=0.0)
        self._require(("deviation",), least=self.least_deviation if self.deviation else 0.0)
        for key, top in (("elites", 1.0), ("risk", 1.0), ("spread", 0.95)):
            if getattr(self, key) > top:
                raise ConfigError(f"{key} is {getattr(self, key):g}, expected at most {top:g}")
        Spline(self.spline, self.knots or 4, 1.0)

    def usual(self, kind: str) -> SamplingSettings:
        """The same with what is usual for a kind of plans, ``FOLLOWS`` or ``LOOKS``, in the place of 0."""
        own = USUAL[kind]
        found: dict[str, Any] = {key: getattr(self, key) or getattr(own, key) for key in vars(own)}
        if self.method == "auto":
            found["method"] = own.method
        if not self.deviation:
            found["deviation"] = max(own.deviation, self.least_deviation)
        elif not self.least_deviation:
            found["least_deviation"] = min(own.least_deviation, self.deviation)
        return replace(self, **found)


def kind_of(model: Model, pose: Array, engine: str) -> str:
    """Of which kind plans of a robot are.

    Args:
        model: what is known of it.
        pose: (nj,) where it begins [rad or m].
        engine: that is asked for; of other robots than those with elastic actuators MuJoCo rolls out plans that look
            where they lead alone.
    """
    robot = model.robot
    if "inverse" not in robot.offers:
        return LOOKS
    if robot.traits.held_in_place:
        return FOLLOWS
    if engine == "mujoco":
        return LOOKS
    try:
        drive = Dynamics(model).authority(pose, np.zeros_like(pose))[0]
    except NotAvailable:
        return LOOKS
    return FOLLOWS if np.any(drive != 0, axis=1).all() and not touching(mjcf_of(model.robot), [pose[None]]) else LOOKS


def there_of(settings: SamplingSettings, robot: Robot, kind: str) -> tuple[str, ...]:
    """What settings may be for, see ``settings.setting``."""
    return (*settable(robot), kind, f"method {settings.usual(kind).method}")
