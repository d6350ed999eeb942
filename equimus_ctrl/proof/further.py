"""Further trials with a ground truth that was recorded before, with noise of their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from equimus_ctrl.errors import ModelError, SimulationDiverged
from equimus_ctrl.experiments.ground import LEAD
from equimus_ctrl.experiments.limits import Excess, Limits, Motions
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.proof.designing import Design
from equimus_ctrl.proof.designs import TrialDesign
from equimus_ctrl.proof.drawing import DESIGN, GroundTruth, along, stream
from equimus_ctrl.proof.seal import digest
from equimus_ctrl.proof.sources import CaseSource
from equimus_ctrl.proof.store import Request, redrawn
from equimus_ctrl.types import Array, Recording

FURTHER = 7
"""Stream of random numbers of where further trials come to rest within dry friction."""
APART = 1_000_003
"""Seeds of further trials' noise are so far apart, and from those of proofs."""


@dataclass(frozen=True, eq=False)
class Made:
    """A further trial.

    Attributes:
        recording: of it.
        motion: (n, 2 nj) where the joints truly were, and their rates, at its samples.
    """

    recording: Recording
    motion: Array

    def excess(self, limits: Limits) -> Excess:
        """How far the true motion left limits, or how near it came to them."""
        position, rate = np.split(self.motion[None], 2, axis=2)
        return limits.excess(Motions(self.recording.time, position, rate, position[:, 0]))


def trial_design(
    source: CaseSource,
    ground_truth: GroundTruth,
    commands: Commands,
    number: int,
    rate: float,
    notes: Mapping[str, str],
) -> TrialDesign:
    """Designed commands as a trial of a robot.

    Args:
        source: of the case.
        ground_truth: of it.
        commands: that are given.
        number: of the trial, from 1 on.
        rate: of the recordings so far [1/s].
        notes: of these that say how they are fitted and whether commands go along lines, see ``Rivals.notes``.
    """
    rng = stream(ground_truth.seed + number * APART, ground_truth.case, DESIGN)
    times = source.sample_times(rng, commands.duration, rate)
    if notes.get("interpolation") == "linear":
        rows = along(times, commands.times, commands.commands)
    else:  # a command that begins at a sample holds there, whatever rounding makes of the instant
        rows = commands.commands[np.searchsorted(commands.times, times + 1e-6 / rate, side="right") - 1]
    return TrialDesign(trial_name(number), "designed", times, rows, commands.start, {**notes, **commands.notes})


def further(source: CaseSource, ground_truth: GroundTruth, design: TrialDesign, number: int) -> Made:
    """One trial more, its commands given as they are.

    A robot that does not settle by itself under the first command is held by that for ``ground.LEAD`` before, as
    designs take it to be: so it begins where it rests itself, not where the nominal one does.

    Args:
        source: of the case.
        ground_truth: of it.
        design: of the trial.
        number: of the trial, from 1 on: its noise, and where the robot rests before it, follow from that.

    Raises:
        ModelError: where the robot finds no rest to begin from.
        SimulationDiverged: where it diverges.
    """
    seed, case = ground_truth.seed + number * APART, ground_truth.case
    places = ground_truth.rest_bias.shape[1]
    bias = stream(seed, case, FURTHER).uniform(-0.8, 0.8, (1, places))
    whole = design if design.settles else _held_before(design)
    found = source.open_loop.driven(replace(ground_truth, trials=(whole,), rest_bias=bias, seed=seed))
    (recording,) = source.recorded(found.ground_truth, found.shown)
    before = len(whole.time) - len(design.time)
    recording = replace(
        recording, time=design.time, command=recording.command[before:], position=recording.position[before:]
    )
    return Made(recording, found.motion[0][before:])


def _held_before(design: TrialDesign) -> TrialDesign:
    """The same after its first command was in force for a while."""
    return replace(
        design,
        time=np.concatenate([[0.0], design.time + LEAD]),
        command=np.concatenate([design.command[:1], design.command]),
    )


def trial_name(number: int) -> str:
    """Of a designed trial."""
    return f"designed_{number:02d}"


def make_trial(
    request: Request, truth: Mapping[str, Any], design: Design, number: int, limits: Limits
) -> tuple[Recording | None, dict[str, Any]]:
    """A designed trial with a robot that is drawn again from its seed: the one step that knows the truth.

    Args:
        request: that the robot was made from.
        truth: its.
        design: of the trial.
        number: of it, from 1 on.
        limits: that it was to keep.

    Returns:
        The recording, and for the score whether the true robot kept the limits; None, and why, where it cannot be made.

    Raises:
        ConfigError: where the robot cannot be drawn again.
    """
    assert design.commands is not None
    source, robot = request.source, redrawn(request, truth)
    try:
        made = further(
            source, robot, trial_design(source, robot, design.commands, number, design.rate, design.notes), number
        )
    except (ModelError, SimulationDiverged) as error:
        return None, {"failed": str(error)}
    found = made.excess(limits)
    return made.recording, {
        "failed": "",
        "kept": not found.left,
        "excess": found.worst,
        "nearest": str(found),
        "recording_sha256": digest([made.recording]),
    }
