"""Where a simulation's numbers stop meaning anything."""

from __future__ import annotations

MAX_SPEED = 1e3
"""Joint velocity far beyond any leg's [rad/s]; a simulation that reaches it has diverged."""
