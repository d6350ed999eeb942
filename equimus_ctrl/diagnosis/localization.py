"""Localization of residuals: by joint, by phase of a trial, by region of angles, speeds and commands."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.diagnosis.display_units import Reading, command, noun, position
from equimus_ctrl.diagnosis.residuals import ResidualLocation
from equimus_ctrl.identification.parameters import place_unit
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

JUST = 0.5
"""How long after a change of command counts as just after it [s]."""
STILL = 0.05
"""Share of a joint's usual speed below which it is at rest."""
LEAST_SAMPLES = 0.03
"""A phase or region with less than this share of the samples is not reported."""
DENSE = 1.2
"""A phase or region is reported where its share of the excess variance exceeds that of the samples so many times."""
REGIONS = 3
"""Parts with as many samples each into which a coordinate's values are divided."""
SLOPE = 4
"""Half the number of samples over which speeds are read off."""


@dataclass(frozen=True, eq=False)
class Class:
    """Samples that have something in common.

    Attributes:
        text: what.
        chosen: for each segment (m,) whether a sample belongs to it.
    """

    text: str
    chosen: tuple[NDArray[np.bool_], ...]


def excess_variances(residuals: Sequence[Array], sigma: Array) -> Array:
    """(nj + ne,) excess residual variance: mean squared residual over the noise's variance, minus 1, at least 0.

    Args:
        residuals: for each segment (m, nj + ne).
        sigma: (nj + ne,) standard deviation of the noise, see ``noise_size.noise_sizes``.
    """
    return np.asarray(np.maximum((np.concatenate(residuals) ** 2).mean(axis=0) / sigma**2 - 1.0, 0.0))


def localise(
    model: Model, segments: Sequence[Segment], residuals: Sequence[Array], sigma: Array
) -> tuple[ResidualLocation, ...]:
    """Joints by their share of the excess residual variance, each with the phase and the region where it is densest.

    Args:
        model: the nominal model, for names and units.
        segments: what was measured.
        residuals: of the refitted model, for each segment (m, nj) [rad or m].
        sigma: (nj,) standard deviation of the joints' noise, and of channels behind them, if any [rad or m].
    """
    joints = model.robot.joint_names
    per_joint = excess_variances(residuals, sigma)[: len(joints)]
    whole = float(per_joint.sum())
    locations = []
    for j in np.argsort(-per_joint):
        squares = [np.maximum((r[:, j] / sigma[j]) ** 2 - 1.0, -1.0) for r in residuals]
        when = _densest(_phases(model, segments, j), squares)
        region = _densest(_regions(model, segments, j), squares)
        share = float(per_joint[j]) / whole if whole > 0 else 0.0
        locations.append(ResidualLocation(joints[j], share, when, region))
    return tuple(locations)


def _densest(classes: Sequence[Class], squares: Sequence[Array]) -> str:
    """The class with the largest p·ln(p/s), in words, with both shares.

    p is its share of the excess squared residuals, s that of the samples: its term of the divergence of the one from
    the other (Kullback & Leibler, 1951). So neither a tiny class that is dense nor a large one that is not is the one.
    """
    everything = np.concatenate(squares)
    total = float(everything.sum())
    if total <= 0:
        return "nowhere in particular"
    best, label = 0.0, "nowhere in particular"
    for c in classes:
        chosen = np.concatenate(c.chosen)
        samples = float(chosen.mean())
        if not LEAST_SAMPLES <= samples <= 1 - LEAST_SAMPLES:
            continue
        part = float(everything[chosen].sum()) / total
        density = part * np.log(max(part / samples, 1.0)) if part > 0 else 0.0
        if density > best and part / samples > DENSE:
            best = density
            share = f"{100 * min(part, 1.0):.0f} % of the excess residual variance"
            label = f"{c.text} ({share} in {100 * samples:.0f} % of the samples)"
    return label


def speeds(segment: Segment) -> Array:
    """(m, nj) measured rates [rad/s or m/s]."""
    t, q = segment.trial.sample_times, segment.measured
    k = min(SLOPE, (len(t) - 1) // 2)
    ahead, behind = np.minimum(np.arange(len(t)) + k, len(t) - 1), np.maximum(np.arange(len(t)) - k, 0)
    return np.asarray((q[ahead] - q[behind]) / (t[ahead] - t[behind])[:, None])


def commands(segment: Segment) -> tuple[Array, Array, Array]:
    """(m, na) command in force, its last change, both in its unit, and the time since then [s], at each sample."""
    trial = segment.trial
    rows = np.vstack([trial.before, trial.commands])
    at = np.searchsorted(trial.times, trial.sample_times, side="right")
    since = np.full((len(at), rows.shape[1]), np.inf)
    change = np.zeros_like(since)
    for a in range(rows.shape[1]):
        moved = np.flatnonzero(np.diff(rows[:, a]) != 0)
        last = np.searchsorted(moved, at - 1, side="right") - 1
        known = last >= 0
        since[known, a] = trial.sample_times[known] - trial.times[moved[last[known]]]
        change[known, a] = (rows[1:, a] - rows[:-1, a])[moved[last[known]]]
    return trial.command_at(trial.sample_times), change, since


def _classes(text: str, segments: Sequence[Segment], of: Callable[[Segment], NDArray[np.bool_]]) -> Class:
    return Class(text, tuple(of(segment) for segment in segments))


def _phases(model: Model, segments: Sequence[Segment], j: int) -> list[Class]:
    usual = float(np.quantile(np.concatenate([np.abs(speeds(s)[:, j]) for s in segments]), 0.95))
    phases = [
        _classes("at rest", segments, lambda s: np.abs(speeds(s)[:, j]) < STILL * usual),
        _classes("q̇ > 0", segments, lambda s: speeds(s)[:, j] > STILL * usual),
        _classes("q̇ < 0", segments, lambda s: speeds(s)[:, j] < -STILL * usual),
        _classes("near a turn of the motion", segments, lambda s: _turning(speeds(s)[:, j], STILL * usual)),
    ]
    if not model.robot.traits.commands_are_pressures:  # so nothing fills or vents
        return phases
    for a, name in enumerate(model.robot.actuator_names):
        for text, sign in (("filling", 1.0), ("venting", -1.0)):

            def just(s: Segment, a: int = a, sign: float = sign) -> NDArray[np.bool_]:
                _, change, since = commands(s)
                return np.asarray((since[:, a] < JUST) & (sign * change[:, a] > 0))

            phases.append(_classes(f"within {JUST:g} s of {text} {name}", segments, just))
    return phases


def _turning(speed: Array, least: float) -> NDArray[np.bool_]:
    """Samples that lie within a few of a change of direction."""
    sign = np.sign(np.where(np.abs(speed) < least, 0.0, speed))
    near = np.zeros(len(speed), dtype=bool)
    moving = np.flatnonzero(sign)
    for before, after in itertools.pairwise(moving):
        if sign[before] != sign[after]:
            near[max(before - SLOPE, 0) : after + SLOPE] = True
    return near


def _regions(model: Model, segments: Sequence[Segment], j: int) -> list[Class]:
    regions = []
    joints, actuators = model.robot.joint_names, model.robot.actuator_names
    coordinates: list[tuple[str, Reading, Callable[[Segment], Array]]] = [
        (f"{name} {noun(model, name)}s", position(model, name), lambda s, i=i: s.measured[:, i])  # type: ignore[misc]
        for i, name in enumerate(joints)
    ]
    plain = Reading(place_unit(model, "rad/s", joints[j]), 1.0)
    coordinates += [
        (f"{joints[j]} speeds", plain, lambda s: np.abs(speeds(s)[:, j])),
        *[
            (f"commands of {name}", command(model, name), lambda s, a=a: commands(s)[0][:, a])
            for a, name in enumerate(actuators)
        ],
    ]
    for text, shown, of in coordinates:
        values = [of(s) for s in segments]
        edges = np.quantile(np.concatenate(values), np.linspace(0, 1, REGIONS + 1))
        for low, high in itertools.pairwise(edges):
            if high > low:
                first, last = (f"{shown.factor * end:.3g}".replace("-", "−") for end in (low, high))
                label = f"{text} of {first} to {last}{'' if shown.unit == '°' else ' '}{shown.unit}".rstrip()
                regions.append(Class(label, tuple((v >= low) & (v <= high) for v in values)))
    return regions
