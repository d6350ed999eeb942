"""Where a simulation's numbers stop meaning anything."""

from __future__ import annotations

MAX_SPEED = 1e3
"""Joint velocity far beyond any robot's [rad/s or m/s]; a simulation that reaches it has diverged."""

FOLLOWED = 1.4
"""Largest |λ|·dt at which the Runge–Kutta method of order four follows a motion well; it is stable up to 2.78."""

PRESSED = 2.4
"""The same at which it follows the force of a stop, whose transients are too short to be seen."""

MOST_DIVISOR = 16
"""Steps are not made shorter than by this: a robot that asks for more is no robot, and may diverge."""

NOTHING = 1e-100
"""Angles and rates smaller than this are none: processors are many times slower with the denormal numbers that speeds
at rest decay into."""

SLIDING = 1e-6
"""Rate [rad/s or m/s] above which what has dry friction slides, and may turn."""

REMEMBERED = 24.0
"""How much of a recording leads at least to a start inside of it, or all that there is [s]: three times the longest
shooting interval, so that of a state that changes more slowly than over one a twentieth is left of how it began."""

MOST_STEPS = 20_000_000
"""Physics steps of a trial: 11 hours by 2 ms. What follows its motion takes memory for each."""
