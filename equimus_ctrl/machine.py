"""What the machine at hand offers."""

from __future__ import annotations

import os


def processors() -> int:
    """How many processors this process may use; fewer than the machine has where an affinity says so."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
