"""What stands between commands, joints and measurements of many simulated robots, as compiled loops.

The laws are those of the single plant: ``effects.command.advance_pressure``, ``effects.shaping.shape_command``,
``effects.sensors.recall`` and ``follow``.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.effects.command import advance_pressure
from equimus_ctrl.effects.sensors import PLAY, SENSOR_DELAY, follow, read, recall
from equimus_ctrl.effects.shaping import shape_command
from equimus_ctrl.types import Array


@njit(cache=True, nogil=True, error_model="numpy")
def shape_commands(rows: NDArray[np.int64], laws: Array, counts: NDArray[np.int64], given: Array, out: Array) -> None:
    """Write what reaches the valves of commands.

    Args:
        rows: of which robots.
        laws: (n, m, 3) of each, see ``effects.shaping.shape_command``.
        counts: (n,) how many it has.
        given: (len(rows), na) commands.
        out: (len(rows), na) written.
    """
    for r in range(len(rows)):
        shape_command(laws[rows[r], : counts[rows[r]]], given[r], out[r])


@njit(cache=True, nogil=True, error_model="numpy")
def arrive(
    rows: NDArray[np.int64],
    times: Array,
    commands: Array,
    counts: NDArray[np.int64],
    before: Array,
    cursor: NDArray[np.int64],
    pressure: Array,
    valve: Array,
    steps: NDArray[np.int64],
    dt: float,
    out: Array,
) -> None:
    """Write what arrives of commands over each of the physics steps that come.

    Args:
        rows: of which robots.
        times: (m,) control instants [s].
        commands: (n, na, m) what reached the valves from each on.
        counts: (n,) how many of them there have been.
        before: (n, na) in force before.
        cursor: (n, na) moved on, see ``effects.command.advance_pressure``.
        pressure: (n, na) moved on.
        valve: (n, na, 6).
        steps: (n,) physics steps so far.
        dt: physics step [s].
        out: (len(rows), k, na) written.
    """
    for r in range(len(rows)):
        e = rows[r]
        n = counts[e]
        for i in range(out.shape[2]):
            for s in range(out.shape[1]):
                pressure[e, i], out[r, s, i], _, cursor[e, i] = advance_pressure(
                    times[:n], commands[e, i, :n], before[e, i], cursor[e, i], (steps[e] + s) * dt, dt,
                    pressure[e, i], valve[e, i],
                )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def sense(
    rows: NDArray[np.int64],
    q: Array,
    v: Array,
    steps: NDArray[np.int64],
    sensor: Array,
    past: Array,
    held: Array,
    dt: float,
    out: Array,
) -> None:
    """Write what sensors show after physics steps, without noise.

    Args:
        rows: of which robots.
        q: (len(rows), k, nj) positions after each step.
        v: (len(rows), k, nj) their rates.
        steps: (n,) physics steps so far, these not among them; moved on.
        sensor: (n, nj, 4), see ``effects.sensors.OFFSET``.
        past: (n, nj, depth, 2) positions and rates, that of step s at s modulo depth; moved on.
        held: (n, nj) where what has play is; moved on.
        dt: physics step [s].
        out: (len(rows), nj) written.
    """
    depth = past.shape[2]
    for r in range(len(rows)):
        e = rows[r]
        for j in range(q.shape[2]):
            seen = q[r, -1, j]
            late = sensor[e, j, SENSOR_DELAY] / dt
            for s in range(q.shape[1]):
                now = steps[e] + s + 1
                past[e, j, now % depth, 0], past[e, j, now % depth, 1] = q[r, s, j], v[r, s, j]
                if sensor[e, j, PLAY] > 0.0:
                    at = recall(past[e, j], now, late, dt) if late > 0.0 else q[r, s, j]
                    held[e, j] = follow(held[e, j], at, sensor[e, j, PLAY])
                    seen = held[e, j]
                elif late > 0.0 and s == q.shape[1] - 1:
                    seen = recall(past[e, j], now, late, dt)
            out[r, j] = read(sensor[e, j], seen)
        steps[e] += q.shape[1]
