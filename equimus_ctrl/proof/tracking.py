"""Controllers of drawn robots: torques that hold each near the recorded motion, as those of the recording did.

Recorded torques are mostly a controller's. Played to a robot of other masses without it they let the robot run away, so
nothing could be learned from its motion. With ``Tracking`` each drawn robot has a controller of its own:

    u_k = u_k(recorded) + G⁺ (M ω² (q_r(t_k) − q) + 2 M ω (v_r(t_k) − v)),    ω = 2πf

q_r, v_r are the recorded motion and its rates by a smoothing spline (Craven & Wahba, 1979), M the nominal robot's
joint-space inertia in the pose where the trial begins, G the joints' torques by commands there. So joints go back to
the recorded motion like critically damped second-order systems of frequency f (computed torque). q, v are the true
motion, without sensors' noise or delay. Commands that are linear between samples have to be known one sample ahead, so
what is added to u_{k+1} is of t_k.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_smoothing_spline

from equimus_ctrl.engines.mjcf_realised import realise
from equimus_ctrl.engines.mjcf_tracking import inertia_and_gains
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import mjcf_of
from equimus_ctrl.types import Array, Recording

MOST = 1 / 12
"""Of the sampling rate, the highest frequency of a controller: its crossover is at twice that, where holding a command
for one sample turns the phase by 30°. Half of it where commands are linear between samples, a sample later."""
FEWEST = 5
"""Samples that a smoothing spline needs."""


@dataclass(frozen=True, eq=False)
class Tracking:
    """The controller of one trial.

    Attributes:
        command: (n, na) recorded, at each sample.
        position: (n, nj) that the joints are to have there [rad or m].
        velocity: (n, nj) of that motion [rad/s or m/s].
        stiffness: (na, nj) G⁺ M ω², in units of commands.
        damping: (na, nj) 2 G⁺ M ω.
        low: (na,) least commands.
        high: (na,) greatest commands.
        interval: between samples [s].
    """

    command: Array
    position: Array
    velocity: Array
    stiffness: Array
    damping: Array
    low: Array
    high: Array
    interval: float

    @classmethod
    def of(cls, model: Model, recording: Recording, frequency: float) -> Tracking:
        """The controller that keeps robots near a recorded motion.

        Args:
            model: the nominal robot.
            recording: of the motion.
            frequency: f [Hz].

        Raises:
            ConfigError: where an actuator is a servo or there is none, samples are too far apart for that frequency, or
                too few.
        """
        robot = mjcf_of(model.robot)
        if servos := [drive.name for drive in robot.actuators if drive.servo]:
            raise ConfigError(f"{robot.name}: {servos[0]} is a servo, which tracks by itself; leave --track out")
        if not robot.actuators:
            raise ConfigError(f"{robot.name} has no actuator, so it cannot track; leave --track out")
        if len(recording.time) < FEWEST:
            raise ConfigError(
                f"{recording.name} has {len(recording.time)} samples, expected at least {FEWEST} to track"
            )
        linear = Trial.of(recording, recording.position[0]).linear
        interval = float(np.median(np.diff(recording.time)))
        most = MOST / (2 if linear else 1) / interval
        if not 0 < frequency <= most:
            raise ConfigError(
                f"track is {frequency:g} Hz, expected more than 0 and at most {most:.3g} Hz, a "
                f"{'twenty-fourth' if linear else 'twelfth'} of the rate of {recording.name}"
            )
        splines = [make_smoothing_spline(recording.time, column) for column in recording.position.T]
        own = realise(model, Trial.of(recording, recording.position[0]))
        inertia, by_command = inertia_and_gains(own, recording.position[0])
        omega, back = 2 * np.pi * frequency, np.linalg.pinv(by_command)
        low, high = np.array([drive.range for drive in robot.actuators]).T
        return cls(
            recording.command,
            np.column_stack([spline(recording.time) for spline in splines]),
            np.column_stack([spline.derivative()(recording.time) for spline in splines]),
            back @ inertia * omega**2,
            back @ inertia * (2 * omega),
            low,
            high,
            interval,
        )

    def converged(self, difference: Array, noise: Array) -> bool:
        """Whether commands (n, na) differ by less than where motions differ by noise (nj,), and their rates with it."""
        most = np.abs(self.stiffness) @ noise + np.abs(self.damping) @ noise / self.interval
        return bool(np.all(np.abs(difference) <= most))

    def within(self, command: Array) -> Array:
        """Commands (n, na) within their ranges."""
        return np.asarray(np.clip(command, self.low, self.high))

    def at(self, sample: int, q: Array, v: Array, ahead: int = 0) -> Array:
        """(na,) a command, for joints at q (nj,) with rates v (nj,) at a sample.

        Args:
            sample: where the joints are.
            q: their positions.
            v: their rates.
            ahead: so many samples later the command holds.
        """
        own = self.stiffness @ (self.position[sample] - q) + self.damping @ (self.velocity[sample] - v)
        return self.within(self.command[sample + ahead] + own)
