"""Trials that nobody has made yet, as they would be recorded and cut, with a model as the truth and without noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.engines.predict import in_its_condition, robot_as_noted
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.engines.trials import Predicted, Trial
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.identification.channels import AXES, Channels
from equimus_ctrl.identification.segments import Segment, cut
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array, Recording

SETTLING = 20.0
"""How long a robot that need not start at rest may take to come to rest under its first command [s]."""
STILL = 0.5
"""Over so long it may move no more than noise then [s]."""


@dataclass(frozen=True, eq=False, repr=False)
class Commands(Short):
    """What is commanded in a trial.

    Attributes:
        times: (n,) ascending instants from which each command holds, or goes along a line to the next [s].
        commands: (n, na), in the unit of each actuator's command; the first has been in force for long.
        duration: of the trial [s].
        start: (nj,) where the joints are at first, at rest [rad or m]; by default where the first command holds them.
        notes: that say what is known to be different in the trial, see ``engines.predict.noted``.
    """

    times: Array
    commands: Array
    duration: float
    start: Array | None = None
    notes: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.times) != len(self.commands) or not np.all(np.diff(self.times) > 0):
            raise ConfigError(
                f"{len(self.commands)} commands at {len(self.times)} times, expected one each, the times ascending"
            )
        if not len(self.times) or not self.times[0] < self.duration:
            raise ConfigError(f"a trial of {self.duration:g} s has no command before its end, expected one or more")

    def sampled(self, rate: float, linear: bool = False) -> tuple[Array, Array]:
        """(m,) sample times at a rate [1/s], and (m, na) the commands there."""
        count = max(int(np.ceil((self.duration - self.times[0]) * rate - 1e-9)), 1)
        times = self.times[0] + np.arange(count) / rate
        if linear:
            return times, np.column_stack([np.interp(times, self.times, column) for column in self.commands.T])
        # A command that begins at a sample holds there, whatever rounding makes of the instant.
        return times, self.commands[np.searchsorted(self.times, times + 1e-6 / rate, side="right") - 1]


def predicted_trials(
    rivals: Rivals, truth: Model, commands: Sequence[Commands], simulator: Simulator
) -> list[list[Segment]]:
    """Trials as they would be recorded without noise, cut as a diagnosis cuts them.

    Args:
        rivals: whose recordings' rate, notes and shooting intervals they have.
        truth: the robot.
        commands: of each trial.
        simulator: that simulates.

    Raises:
        ConfigError: where the robot does not come to rest under the first command.
        SimulationDiverged: where the simulation does.
    """
    recordings = predicted_recordings(rivals, truth, commands, simulator)
    # Without noise, starts would seem to be as sure as parabolas are: those of the rivals' recordings tell.
    segments = cut(rivals.model, recordings, shoot=rivals.interval, fit_start=True, trust=rivals.trust)
    return [[s for s in segments if s.recording == k] for k in range(len(recordings))]


def predicted_recordings(
    rivals: Rivals, truth: Model, commands: Sequence[Commands], simulator: Simulator
) -> list[Recording]:
    """The same before they are cut."""
    robot, nj = truth.robot, len(truth.robot.joint_names)
    bare = Recording(
        "trial", np.zeros(1), np.zeros((1, len(robot.actuator_names))), np.zeros((1, nj)), robot.actuator_names,
        robot.joint_names, notes=rivals.notes,
    )  # fmt: skip
    channels = rivals.channels
    trials, starts, noted, known = [], [], [], dict[tuple[bytes, str], Array]()
    for k, own in enumerate(commands):
        times, rows = own.sampled(rivals.rate, bare.linear)
        pose, first = own.start, (rows[0].tobytes(), repr(sorted(own.notes.items())))
        if pose is None:
            if first not in known:
                known[first] = resting(rivals, as_noted(truth, own.notes), rows[0], simulator)
            pose = known[first]
        trial = Trial(
            f"trial {k + 1}", times, rows, rows[0], float(times[0]), pose, times, linear=bare.linear,
            inner=bool(channels), forces=bool(channels.forces),
        )  # fmt: skip
        noted.append(replace(bare, notes={**bare.notes, **own.notes}))
        trials.append(in_its_condition(truth, noted[-1], trial))
        starts.append(np.concatenate([pose, np.zeros(nj)])[None])
    found = simulator.engine.simulate([truth], trials, starts, simulator.threads)
    for trial, one in zip(trials, found, strict=True):
        if not one.sound[0]:
            raise SimulationDiverged(f"{trial.name}: the simulation of {truth.name} diverges")
    return [_recorded(own, trial, one, truth, channels) for own, trial, one in zip(noted, trials, found, strict=True)]


def as_noted(model: Model, notes: Mapping[str, str]) -> Model:
    """A model as it is in a trial with such notes."""
    return replace(model, robot=robot_as_noted(model.robot, "the trial", notes)) if notes else model


def _recorded(bare: Recording, trial: Trial, found: Predicted, truth: Model, channels: Channels) -> Recording:
    """A prediction in the form of a recording."""
    nj = len(bare.joints)
    recording = replace(
        bare, name=trial.name, time=trial.times, command=trial.commands, position=found.position[0], before=trial.before
    )
    if not channels:
        return recording
    assert found.motion is not None  # the trial asks for it
    beside = channels.added(truth.robot, found, trial.moved).position[0, :, nj:]
    first = len(channels.velocities)
    sites = {f"{n}.{AXES[axis]}": beside[:, first + k] for k, (n, axis) in enumerate(channels.sites)}
    return replace(
        recording,
        velocity=found.motion[0, :, nj : 2 * nj] if channels.velocities else None,
        measured=found.forces[0] if channels.forces and found.forces is not None else None,
        sites=sites,
    )


def resting(rivals: Rivals, truth: Model, command: Array, simulator: Simulator, begin: Array | None = None) -> Array:
    """(nj,) where a robot rests under a constant command (na,) [rad or m].

    Robots that start at rest have been under it for long; others are let go where recordings began, and left until they
    move no more than noise.

    Args:
        rivals: whose noise and starts count.
        truth: the robot.
        command: in force for long.
        simulator: that simulates.
        begin: (nj,) where robots that need not start at rest are let go [rad or m].

    Raises:
        ConfigError: where it does not come to rest.
    """
    if truth.robot.traits.starts_at_rest:
        return rest_pose(truth, command)
    nj = len(truth.robot.joint_names)
    ends = np.linspace(SETTLING - STILL, SETTLING, 11)
    at = rivals.start if begin is None else begin
    trial = Trial("rest", np.zeros(1), command[None], command, 0.0, at, ends, inner=True)
    (found,) = simulator.engine.simulate(
        [truth], [trial], [np.concatenate([at, np.zeros(nj)])[None]], simulator.threads
    )
    moved = np.ptp(found.position[0], axis=0)
    sigma = np.array([own.sigma for own in rivals.noise[:nj]])
    if not (found.sound[0] and np.all(moved < sigma)):
        raise ConfigError(
            f"{truth.name} does not come to rest within {SETTLING:g} s of a constant command, so it cannot be driven "
            "in open loop; expected commands that hold it, or a pose to start from"
        )
    assert found.motion is not None  # the trial asks for it
    return np.asarray(found.motion[0, -1, :nj])
