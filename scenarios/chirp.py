"""Commands that sweep through the frequencies, one actuator against the other: excitation for identification.

Where nothing holds a robot in place the joints' reference sweeps, and a controller follows it.
"""

import numpy as np

import equimus_ctrl as eq

MEAN, AMPLITUDE, SWING = 15.0, 12.0, 10.0
"""Of pressures [kPa], and of joints [° or mm]."""


def build(
    context: eq.ScenarioContext,
    duration: float = 20.0,
    mean: float = MEAN,
    amplitude: float = AMPLITUDE,
    low: float = 0.05,
    high: float = 2.0,
    swing: float = SWING,
) -> eq.Scenario:
    """Mean and amplitude of pressures in kPa, of joints by ``swing`` in degrees (slides mm); frequencies in Hz.

    The sweep is exponential; that of pressures starts at the mean's equilibrium, that of joints in the own pose.
    """
    if not (0 < duration < 1e4 and 0 < low < high):
        raise eq.ConfigError(
            f"duration is {duration:g} s from {low:g} to {high:g} Hz; expected 0 < duration, 0 < low < high"
        )
    times = np.arange(0.0, duration, 1 / 120)
    rate = np.log(high / low) / duration
    phase = 2 * np.pi * low * (np.exp(rate * times) - 1) / rate
    robot = context.robot
    springs = robot.traits.held_in_place
    unused = {"swing": swing != SWING} if springs else {"mean": mean != MEAN, "amplitude": amplitude != AMPLITUDE}
    if any(unused.values()):
        name = next(name for name, given in unused.items() if given)
        raise eq.ConfigError(
            f"{name} is of robots whose {'joints sweep' if springs else 'pressures sweep'}; {robot.name} sweeps its "
            f"{'pressures, see mean and amplitude' if springs else 'joints, see swing'}"
        )
    if not springs:
        middle, most = context.swings(swing)
        waves = np.stack([np.sin(phase * (1 + 0.37 * j)) for j in range(len(middle))], axis=1)
        share, wanted = context.within_means(times, middle, most * waves)
        return eq.Scenario(
            name="chirp",
            summary=f"joints sweep {low:g} to {high:g} Hz by {swing * share:.3g}",
            duration=duration,
            reference=eq.SampledReference(times, wanted),
            start=context.start(middle),
        )
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
