"""Each joint follows a sum of sines of its own about a pose, within its range and what its actuators can do."""

import math

import numpy as np

import equimus_ctrl as eq

RATE = 120.0


def build(
    context: eq.ScenarioContext,
    duration: float = 20.0,
    swing: float = 15.0,
    high: float = 1.0,
    period: float = 10.0,
    keyframe: str = "",
    **joints: float,
) -> eq.Scenario:
    """Swing in degrees, slides mm; times in seconds, the highest frequency in Hz.

    Frequencies are multiples of 1/period, every joint has others, with Schroeder's phases (IEEE Transactions on
    Information Theory 16, 1970); the period is longer where there are more joints than such frequencies. The pose is a
    keyframe, the first by default, with joints that differ from it; the first second, in which the motion grows, is not
    scored. Where a robot cannot do as much, it swings less.
    """
    if not (0 < duration < 1e4 and period > 0 and 1 / period <= high < RATE / 4):
        raise eq.ConfigError(
            f"duration is {duration:g} s, high {high:g} Hz, period {period:g} s; expected 0 < duration and "
            "0 < 1/period <= high"
        )
    middle, most = context.swings(swing, context.pose(joints, keyframe))
    nj = len(context.robot.joint_names)
    period = max(period, nj / high)
    times = np.arange(0.0, duration + 1.0, 1 / RATE)
    waves = np.zeros((len(times), nj))
    for j in range(nj):
        own = range(j + 1, math.floor(high * period * (1 + 1e-9)) + 1, nj)
        for n, k in enumerate(own, start=1):
            waves[:, j] += np.cos(2 * np.pi * k * times / period - np.pi * n * (n - 1) / len(own))
    grown = eq.minimum_jerk(times)[:, None]
    share, values = context.within_means(times, middle, grown * most * waves / np.abs(waves).max(axis=0))
    return eq.Scenario(
        name="multisine",
        summary=f"sums of sines up to {high:g} Hz in each joint, by {swing * share:.3g}",
        duration=duration,
        reference=eq.SampledReference(times, values),
        start=context.start(middle),
        score_window=(min(1.0, duration / 2), duration),
    )
