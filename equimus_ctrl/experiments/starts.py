"""The free numbers with which segments of a trial start, eliminated from whatever is compared there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.identification.information import start_precision
from equimus_ctrl.identification.noise import Noise, whiten
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class Starts:
    """Free numbers of the segments' starts, eliminated to first order with the prior that they have in fits.

    Of whitened values v, with N the whitened derivatives by a start and P its prior precision's root, it leaves
    [v − N s, P s] at the s at which the sum of their squares is least.

    Attributes:
        noise: by which values are whitened.
        segments: whose starts.
        slopes: for each (m, nc, s) derivatives by a start.
        by_start: for each (N, s) N.
        answers: for each (s, N) s of v.
    """

    noise: Noise
    segments: tuple[Segment, ...]
    slopes: tuple[Array, ...]
    by_start: tuple[Array, ...]
    answers: tuple[Array, ...]

    @classmethod
    def of(cls, noise: Noise, segments: Sequence[Segment], slopes: Sequence[Array]) -> Starts:
        """Of derivatives (m, nc, s) by the free numbers of each segment's start."""
        columns, answers = list[Array](), list[Array]()
        for segment, slope in zip(segments, slopes, strict=True):
            own = whiten(noise, segment.trial.sample_times, slope).reshape(-1, slope.shape[2])
            columns.append(own)
            held = own.T @ own + np.diag(start_precision(segment, noise) ** 2)
            answers.append(np.asarray(np.linalg.solve(held, own.T), dtype=np.float64))
        return cls(noise, tuple(segments), tuple(slopes), tuple(columns), tuple(answers))

    def reduced(self, place: int, values: Array) -> Array:
        """(N + s, k) of values (m, nc, k) of a segment [rad, m or a channel's own unit]."""
        segment, by_start = self.segments[place], self.by_start[place]
        whole = whiten(self.noise, segment.trial.sample_times, values).reshape(-1, values.shape[2])
        own = self.answers[place] @ whole
        return np.concatenate([whole - by_start @ own, start_precision(segment, self.noise)[:, None] * own])

    def left(self, place: int, values: Array) -> Array:
        """(m, nc) of values (m, nc) of a segment, what no start takes, not whitened."""
        whole = whiten(self.noise, self.segments[place].trial.sample_times, values[..., None])
        return np.asarray(values - self.slopes[place] @ (self.answers[place] @ whole.ravel()))
