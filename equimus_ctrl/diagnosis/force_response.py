"""Motions of a model, and what small generalised forces along them change, by whatever its engine can do."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from equimus_ctrl.diagnosis.linear_response import linearise
from equimus_ctrl.engines.base import Engine, ForceResponse
from equimus_ctrl.engines.mjcf_motion import simulated_response
from equimus_ctrl.engines.motion import motion
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

STEP = 2e-3
"""Physics step of a motion that equations are linearised along [s]."""


def force_response(
    engine: Engine,
    model: Model,
    trials: Sequence[Trial],
    starts: Sequence[Array],
    scale: Callable[[], Array],
    dt: float = STEP,
) -> ForceResponse:
    """A model's motions through trials, and its answers to small forces along them.

    Args:
        engine: that simulates the model.
        model: what moves.
        trials: what is done.
        starts: for each (2 nj,) positions and velocities at its start.
        scale: gives (nj,) the usual size of forces at the joints [N·m or N]; asked where forces are simulated, for
            what is small beside them.
        dt: physics step of motions that equations are linearised along [s].

    Raises:
        SimulationDiverged: where a motion cannot be followed.
    """
    if engine.responds_by == "simulated":
        return simulated_response(model, trials, starts, scale())
    step = min(dt, engine.step or dt)
    return linearise(model, [motion(model, trial, start, step) for trial, start in zip(trials, starts, strict=True)])
