"""The engines as fits call them: many models, segments and starts at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.engines.base import Engine
from equimus_ctrl.engines.choice import STEP, ReducedEngine, engine_for
from equimus_ctrl.engines.predict import behind_all
from equimus_ctrl.engines.trials import Predicted
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class Simulator:
    """An engine that is given segments, and starts as the sensors show them.

    Attributes:
        engine: that simulates.
        threads: as many as there are cores by default.
    """

    engine: Engine
    threads: int | None = None

    def __call__(
        self, models: Sequence[Model], segments: Sequence[Segment], starts: Sequence[Array]
    ) -> list[Predicted]:
        """Predictions for each segment, each model as it is in the segment's group of trials.

        Args:
            models: that predict.
            segments: what was done.
            starts: for each segment (k, 2 nj + nz + 2 nl), see ``Segment.start``, one row a model.
        """
        if not any(model.by_group for model in models):
            return self._simulated(models, segments, starts)
        found: dict[int, Predicted] = {}
        for group in dict.fromkeys(segment.group for segment in segments):
            rows = [k for k, segment in enumerate(segments) if segment.group == group]
            own = [model.in_group(group) for model in models]
            predicted = self._simulated(own, [segments[k] for k in rows], [starts[k] for k in rows])
            found |= dict(zip(rows, predicted, strict=True))
        return [found[k] for k in range(len(segments))]

    def _simulated(
        self, models: Sequence[Model], segments: Sequence[Segment], starts: Sequence[Array]
    ) -> list[Predicted]:
        parts = [s.parted(rows) for s, rows in zip(segments, starts, strict=True)]
        shown, offsets, beside = zip(*parts, strict=True)
        trials = [s.trial for s in segments]
        true = [
            np.concatenate([joints, loose], axis=1)
            for joints, loose in zip(behind_all(models, shown, trials), beside, strict=True)
        ]
        found = self.engine.simulate(models, trials, true, self.threads)
        shifted = [
            replace(own, position=own.position + offset[:, None]) if segment.zeros else own
            for segment, own, offset in zip(segments, found, offsets, strict=True)
        ]
        return [
            segment.channels.added(models[0].robot, own, segment.trial.moved) if segment.channels else own
            for segment, own in zip(segments, shifted, strict=True)
        ]


def reduced_simulator(dt: float | None = None, threads: int | None = None, longest: float = STEP) -> Simulator:
    """The reduced engine, see ``engines.choice.ReducedEngine``."""
    return Simulator(ReducedEngine(dt, longest), threads)


def simulator_for(model: Model, positions: Sequence[Array] = (), threads: int | None = None) -> Simulator:
    """The engine that a model is fitted with to measured positions (n, nj) each by default."""
    return Simulator(engine_for(model, positions=positions), threads)
