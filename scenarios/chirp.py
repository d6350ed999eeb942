"""Pressures that sweep through the frequencies, one actuator against the other: excitation for identification."""

import numpy as np

import equimus_ctrl as eq


def build(
    context: eq.ScenarioContext,
    duration: float = 20.0,
    mean: float = 15.0,
    amplitude: float = 12.0,
    low: float = 0.05,
    high: float = 2.0,
) -> eq.Scenario:
    """Mean and amplitude in kPa, frequencies in Hz; the sweep is exponential and starts at the mean's equilibrium."""
    if not (0 < duration < 1e4 and 0 < low < high):
        raise eq.ConfigError(
            f"duration is {duration:g} s from {low:g} to {high:g} Hz; expected 0 < duration, 0 < low < high"
        )
    times = np.arange(0.0, duration, 1 / 120)
    rate = np.log(high / low) / duration
    phase = 2 * np.pi * low * (np.exp(rate * times) - 1) / rate
    n = len(context.morphology.actuators)
    values = 1e3 * np.stack([mean + amplitude * np.sin(phase * (1 + 0.37 * i)) for i in range(n)], axis=1)
    profile = context.profile(times, values)
    # The reference is what slow commands would give, so that closed-loop controllers can be asked to follow it too.
    knots = np.arange(0, len(times), 4)
    return eq.Scenario(
        name="chirp",
        summary=f"pressures sweep {low:g} to {high:g} Hz around {mean:g} kPa",
        duration=duration,
        reference=eq.SampledReference(times[knots], context.kinematics.equilibria(values[knots])),
        start=eq.Start(command=values[0]),
        commands=profile,
        controller="open_loop",
    )
