"""The laws of PID, valves and sensors compiled in a second process, while the first compiles the equations of motion.

Compiling takes seconds the first time a robot's structure is met, and numba compiles one function at a time within a
process. Both processes leave what they made in the same cache.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np

from equimus_ctrl.controllers import pid_kernel
from equimus_ctrl.effects.command import advance_pressure
from equimus_ctrl.effects.sensors import follow, recall
from equimus_ctrl.effects.shaping import shape_command
from equimus_ctrl.engines import compiled
from equimus_ctrl.models.model import Model, model_from_dict, model_to_dict


def compile_laws(model: Model) -> None:
    """Compile the functions of PID, valves and sensors for a model's structure, or load them from the cache.

    Args:
        model: whose structure.
    """
    m = model.morphology
    law = compiled.load(m, model.phase, pid_kernel)
    constants = compiled.prepared(m, model.phase)
    nj, na = len(m.joints), len(m.actuators)
    y, command, gains, state = np.ones(nj), np.zeros(na), np.ones((7, na)), np.zeros((3, na))
    law.static_feed(y, True, constants, command)
    law.pid_start(y, command, gains, True, constants, state)
    law.pid_command(y, y, y, command, gains, True, np.zeros(na), np.ones(na), 0.01, constants, state, command)
    shape_command(np.empty((0, 3)), command, np.empty(na))
    advance_pressure(np.zeros(1), np.zeros(1), 0.0, -1, 0.0, 0.01, 0.0, np.zeros(6))
    follow(recall(np.zeros((1, 2)), 0, 0.0, 0.01), 0.0, 0.0)
    compiled.mark_compiled(law)


def start(model: Model) -> subprocess.Popen[str] | None:
    """Begin to compile the laws in another process; None where they are compiled already.

    Wait for it with ``finish``. A process that fails is no loss: the laws are then compiled where they are needed.
    """
    if compiled.is_marked_compiled(compiled.load(model.morphology, model.phase, pid_kernel)):
        return None
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert process.stdin is not None
        # Only the structure counts, and the other process knows no effects of a user's own.
        process.stdin.write(json.dumps(model_to_dict(replace(model, effects=()))))
        process.stdin.close()
    except OSError:
        return None
    return process


def finish(process: subprocess.Popen[str] | None) -> None:
    """Wait until the other process is done; stop it where the wait is interrupted."""
    if process is None:
        return
    try:
        process.wait()
    except BaseException:
        process.kill()
        process.wait()
        raise


if __name__ == "__main__":
    compile_laws(model_from_dict(json.load(sys.stdin)))
