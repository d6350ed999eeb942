"""Further trials with a ground truth that was recorded before, with noise of their own."""

from __future__ import annotations

from dataclasses import replace

from equimus_ctrl.proof.designs import TrialDesign
from equimus_ctrl.proof.drawing import CaseSource, GroundTruth, stream
from equimus_ctrl.types import Recording

FURTHER = 7
"""Stream of random numbers of where further trials come to rest within dry friction."""
APART = 1_000_003
"""Seeds of further trials' noise are so far apart, and from those of proofs."""


def further(source: CaseSource, ground_truth: GroundTruth, design: TrialDesign, number: int) -> Recording:
    """The recording of one trial more.

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
    driven, clean = source.simulate(replace(ground_truth, trials=(design,), rest_bias=bias, seed=seed))
    (found,) = source.recorded(driven, clean)
    return found
