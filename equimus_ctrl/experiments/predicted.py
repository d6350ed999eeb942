"""Trials that nobody has made yet, as they would be recorded and cut, with a model as the truth and without noise.

Where joints track references, what is commanded follows from what is measured: each model has commands of its own. A
diagnosis compares what was measured with what models do under the commands that were recorded. So the model that is
taken for the truth is simulated in closed loop, once, and all models then under *its* commands, over the same shooting
intervals as of any recording, so that an open loop that is not stable has no time to diverge. By the noise that is
fed back commands differ a little from these; that they are recorded, whatever they are, is what counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from equimus_ctrl.diagnosis.holdout import end_of
from equimus_ctrl.diagnosis.intervals import longest_interval
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.engines.choice import MujocoEngine, simulation_of
from equimus_ctrl.engines.predict import in_its_condition, robot_as_noted
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.engines.trials import Predicted, Trial
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.identification.channels import AXES, Channels
from equimus_ctrl.identification.segments import Segment, cut
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array, FeedbackLaw, Recording

SETTLING = 20.0
"""How long a robot that need not start at rest may take to come to rest under its first command [s]."""
STILL = 0.5
"""Over so long it may move no more than noise then [s]."""
INSTANTS = 10
"""At which it is looked at in that time."""
NEAR = 10.0
"""So many times as far as it was let go beside a pose may a robot go from there that rests in it: what is not stable
goes farther, unless it does so too slowly to count in a trial."""


@dataclass(frozen=True, eq=False, repr=False)
class Commands(Short):
    """What is commanded in a trial.

    Attributes:
        times: (n,) ascending instants from which each command holds, or goes along a line to the next [s].
        commands: (n, na), in the unit of each actuator's command; the first has been in force for long.
        duration: of the trial [s].
        start: (nj,) where the joints are at first, at rest [rad or m]; by default where the first command holds them.
        notes: that say what is known to be different in the trial, see ``engines.predict.noted``.
        reference: (n, nj) where joints are to be, in a trial in which they track that [rad or m]; the commands are fed
            forward then.
        law: of the feedback by which they do.
    """

    times: Array
    commands: Array
    duration: float
    start: Array | None = None
    notes: Mapping[str, str] = field(default_factory=dict)
    reference: Array | None = None
    law: FeedbackLaw | None = None

    def __post_init__(self) -> None:
        if (self.reference is None) != (self.law is None):
            raise ConfigError("a reference of joints is tracked by a feedback law, expected both or none")
        if len(self.times) != len(self.commands) or not np.all(np.diff(self.times) > 0):
            raise ConfigError(
                f"{len(self.commands)} commands at {len(self.times)} times, expected one each, the times ascending"
            )
        if not len(self.times) or not self.times[0] < self.duration:
            raise ConfigError(f"a trial of {self.duration:g} s has no command before its end, expected one or more")

    @property
    def course(self) -> Array:
        """(n, …) what was designed: the reference where joints track one, else the commands."""
        return self.commands if self.reference is None else self.reference

    def sampled(self, rate: float, linear: bool = False) -> tuple[Array, Array]:
        """(m,) sample times at a rate [1/s], and (m, na) the commands there."""
        count = max(int(np.ceil((self.duration - self.times[0]) * rate - 1e-9)), 1)
        times = self.times[0] + np.arange(count) / rate
        if linear or self.law is not None:
            return times, _along(times, self.times, self.commands)
        # A command that begins at a sample holds there, whatever rounding makes of the instant.
        return times, self.commands[np.searchsorted(self.times, times + 1e-6 / rate, side="right") - 1]

    def tracked(self, rate: float, lead: float = 0.0) -> tuple[Array, Array, Array]:
        """Instants (m,), what is fed forward (m, na) and where joints are to be (m, nj), in a trial that tracks.

        Args:
            rate: of the feedback [1/s].
            lead: how long it has been held at the first reference before [s].
        """
        assert self.reference is not None
        times, feed = self.sampled(rate)
        early = times[0] - np.arange(round(lead * rate), 0, -1) / rate
        whole = np.concatenate([early, times])
        feed = np.concatenate([np.tile(feed[0], (len(early), 1)), feed])
        return whole, feed, _along(whole, self.times, self.reference)


def _along(times: Array, knots: Array, values: Array) -> Array:
    return np.column_stack([np.interp(times, knots, column) for column in values.T])


def predicted_trials(
    rivals: Rivals, truth: Model, commands: Sequence[Commands], simulator: Simulator
) -> list[list[Segment]]:
    """Trials as they would be recorded without noise, cut as a diagnosis cuts them, as far as they are fitted.

    Args:
        rivals: whose recordings' rate, notes and shooting intervals they have.
        truth: the robot.
        commands: of each trial.
        simulator: that simulates.

    Raises:
        ConfigError: where the robot does not come to rest under the first command.
        SimulationDiverged: where the simulation does.
    """
    # Without noise, starts would seem to be as sure as parabolas are: those of the rivals' recordings tell.
    return [
        cut(rivals.model, [own], window=(float(own.time[0]), _fitted_until(own, rivals.fitted)),
            shoot=_interval(rivals, own, simulator), fit_start=True, trust=rivals.trust)
        for own in predicted_recordings(rivals, truth, commands, simulator)
    ]  # fmt: skip


def _interval(rivals: Rivals, recording: Recording, simulator: Simulator) -> float | None:
    """How long a recording's shooting intervals are going to be [s]; None where it is simulated whole."""
    if rivals.model.robot.traits.held_in_place:
        return rivals.interval
    # A model follows its own motion for ever. So noise is added, and the model is as far off as estimates are.
    rng, first = np.random.default_rng(0), rivals.rivals[0]
    sigma = np.array([own.sigma for own in rivals.noise[: len(recording.joints)]])
    noisy = replace(recording, position=recording.position + sigma * rng.standard_normal(recording.position.shape))
    known = first.model_at(first.draws(rng, 1)[0])
    try:
        return longest_interval(known, [noisy], simulator=simulator).length
    except SimulationDiverged:
        return rivals.interval


def _fitted_until(recording: Recording, share: float) -> float:
    """Until when a recording is fitted [s]: to its end, where what would be held out of that is too short."""
    edge = end_of(recording, 1.0 - share)
    return float(recording.time[-1]) if edge is None else edge


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
    played: dict[int, Predicted] = {}
    for k, own in enumerate(commands):
        if own.law is not None:
            trial, found_there = _tracked(bare, truth, f"trial {k + 1}", own, rivals, simulator)
            noted.append(replace(bare, notes={**bare.notes, **own.notes}))
            trials.append(trial)
            played[k] = found_there
            continue
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
    open_loop = [trial for k, trial in enumerate(trials) if k not in played]
    rest = iter(simulator.engine.simulate([truth], open_loop, starts, simulator.threads) if open_loop else ())
    found = [played[k] if k in played else next(rest) for k in range(len(trials))]
    for trial, one in zip(trials, found, strict=True):
        if not one.sound[0]:
            raise SimulationDiverged(f"{trial.name}: the simulation of {truth.name} diverges")
    return [_recorded(own, trial, one, truth, channels) for own, trial, one in zip(noted, trials, found, strict=True)]


def _tracked(
    bare: Recording, truth: Model, name: str, own: Commands, rivals: Rivals, simulator: Simulator
) -> tuple[Trial, Predicted]:
    """A trial in closed loop with the commands that are given in it, and what is seen of it."""
    assert own.law is not None
    assert own.start is not None
    times, feed, reference = own.tracked(rivals.rate)
    trial = Trial(
        name, times, feed, feed[0], float(times[0]), own.start, times, inner=True, forces=bool(rivals.channels.forces)
    )  # fmt: skip
    trial = in_its_condition(truth, replace(bare, notes={**bare.notes, **own.notes}), trial)
    start = np.concatenate([own.start, np.zeros(len(own.start))])[None]
    engine = closed_loop_engine(truth)
    found = engine.tracked([truth], trial, reference, own.law, start, threads=simulator.threads)
    return replace(trial, commands=found.command[0]), found.predicted


def closed_loop_engine(model: Model) -> MujocoEngine:
    """What simulates a model whose joints track references.

    Raises:
        ConfigError: for a robot of which nothing does.
    """
    engine = simulation_of(model)
    if engine is None:
        raise ConfigError(f"{model.name} cannot be simulated with feedback on references, expected commands to play")
    return replace(engine, hard_friction=True)


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


def resting(
    rivals: Rivals, truth: Model, command: Array, simulator: Simulator, begin: Array | None = None, beside: bool = False
) -> Array:
    """(nj,) where a robot rests under a constant command (na,) [rad or m].

    Robots that start at rest have been under it for long; others are let go where recordings began, and left until they
    move no more than noise.

    Args:
        rivals: whose noise and starts count.
        truth: the robot.
        command: in force for long.
        simulator: that simulates.
        begin: (nj,) where robots that need not start at rest are let go [rad or m].
        beside: lets them go as far from there as noise, so that a pose in which one is balanced but does not stay is
            none to rest in. One that swings about ``begin`` with little to damp it rests there: it never goes farther
            away than ``NEAR`` times the noise.

    Raises:
        ConfigError: where it does not come to rest.
    """
    if truth.robot.traits.starts_at_rest:
        return rest_pose(truth, command)
    nj = len(truth.robot.joint_names)
    sigma = np.array([own.sigma for own in rivals.noise[:nj]])
    place = rivals.start if begin is None else begin
    at = place + sigma if beside else place
    instants = np.linspace(0.0, SETTLING, round(SETTLING / STILL) * INSTANTS + 1)
    trial = Trial("rest", np.zeros(1), command[None], command, 0.0, at, instants, inner=True)
    (found,) = simulator.engine.simulate(
        [truth], [trial], [np.concatenate([at, np.zeros(nj)])[None]], simulator.threads
    )
    assert found.motion is not None  # the trial asks for it
    motion = found.motion[0, :, :nj]
    if found.sound[0]:
        if np.all(np.ptp(found.position[0, -INSTANTS - 1 :], axis=0) < sigma):
            return np.asarray(motion[-1])
        if beside and np.all(np.abs(motion - place) <= NEAR * sigma):
            return place
    raise ConfigError(
        f"{truth.name} does not come to rest within {SETTLING:g} s of a constant command, so it cannot be driven "
        "in open loop; expected commands that hold it, or a pose to start from"
    )
