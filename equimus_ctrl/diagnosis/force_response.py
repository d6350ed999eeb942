"""Motions of a model, and what small generalised forces along them change, by whatever its engine can do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from equimus_ctrl.diagnosis.linear_response import linearise
from equimus_ctrl.engines.base import Engine, ForceResponse
from equimus_ctrl.engines.mjcf_motion import simulated_response
from equimus_ctrl.engines.motion import Motion, motion
from equimus_ctrl.engines.predict import behind_sensors
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

T = TypeVar("T")
STEP = 2e-3
"""Physics step of a motion that equations are linearised along [s]."""


def force_response(
    engine: Engine,
    model: Model,
    trials: Sequence[Trial],
    starts: Sequence[Array],
    scale: Callable[[], Array],
    dt: float = STEP,
    threads: int | None = None,
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
        threads: among which simulated forces are shared out; as many as there are processors by default.

    Raises:
        SimulationDiverged: where a motion cannot be followed.
    """
    if engine.responds_by == "simulated":
        return simulated_response(model, trials, starts, scale(), threads)
    step = min(dt, engine.step or dt)
    return linearise(model, [motion(model, trial, start, step) for trial, start in zip(trials, starts, strict=True)])


@dataclass(frozen=True, eq=False)
class _ByGroup:
    """Responses of a model that is another in each group of trials.

    Attributes:
        rows: for each group which of the trials are its.
        parts: for each group its response.
    """

    rows: tuple[tuple[int, ...], ...]
    parts: tuple[ForceResponse, ...]

    @property
    def motions(self) -> tuple[Motion, ...]:
        return tuple(_in_order(self.rows, [part.motions for part in self.parts]))

    def response(self, torques: Sequence[Array]) -> list[Array]:
        found = [p.response([torques[k] for k in rows]) for rows, p in zip(self.rows, self.parts, strict=True)]
        return _in_order(self.rows, found)

    def inner_response(self, torques: Sequence[Array]) -> list[Array]:
        found = [p.inner_response([torques[k] for k in rows]) for rows, p in zip(self.rows, self.parts, strict=True)]
        return _in_order(self.rows, found)

    def drive_response(self, torques: Sequence[Array]) -> list[Array]:
        found = [p.drive_response([torques[k] for k in rows]) for rows, p in zip(self.rows, self.parts, strict=True)]
        return _in_order(self.rows, found)


def _in_order(rows: Sequence[Sequence[int]], parts: Sequence[Sequence[T]]) -> list[T]:
    placed = {k: own for of, part in zip(rows, parts, strict=True) for k, own in zip(of, part, strict=True)}
    return [placed[k] for k in range(len(placed))]


def segment_response(
    engine: Engine,
    model: Model,
    segments: Sequence[Segment],
    starts: Sequence[Array],
    scale: Callable[[], Array],
    dt: float = STEP,
    threads: int | None = None,
) -> ForceResponse:
    """``force_response`` through segments, from starts as the sensors show them, the model as it is in each group."""
    groups = dict.fromkeys(segment.group for segment in segments)
    rows = tuple(tuple(k for k, s in enumerate(segments) if s.group == group) for group in groups)
    parts = []
    for group, of in zip(groups, rows, strict=True):
        own = model.in_group(group)
        parted, trials = [segments[k].parted(starts[k][None, :]) for k in of], [segments[k].trial for k in of]
        true = [
            np.append(behind_sensors([own], shown, trial)[0], beside[0])
            for trial, (shown, _, beside) in zip(trials, parted, strict=True)
        ]
        parts.append(force_response(engine, own, trials, true, scale, dt, threads))
    return _ByGroup(rows, tuple(parts))
