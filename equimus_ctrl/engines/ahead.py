"""Kernels compiled ahead, in processes of their own, while the caller does something else.

numba compiles one function at a time in a process; what other processes compile lies in the cache afterwards.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Sequence
from types import TracebackType

import numpy as np

from equimus_ctrl.engines.batch import Trial, simulate
from equimus_ctrl.models.model import Model

_CHILD = f"from {__name__} import _work; _work()"


class CompiledAhead:
    """Compiles the batch kernels of some models from the moment it is entered; leaving it stops what is under way.

    Nothing depends on it but time: a kernel that no process could compile is compiled where it is needed.

    Args:
        models: whose kernels, in the order in which they will be needed.
        processes: at most.
    """

    def __init__(self, models: Sequence[Model], processes: int) -> None:
        count = max(min(processes, len(models)), 0)
        self._shares = [list(models[i::count]) for i in range(count)]
        self._children: list[subprocess.Popen[bytes]] = []
        self._done = [0] * count

    def __enter__(self) -> CompiledAhead:
        for share in self._shares:
            # Away from the terminal's interrupts: who started it ends it.
            child = subprocess.Popen(
                [sys.executable, "-c", _CHILD],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
            self._children.append(child)
            assert child.stdin is not None
            try:
                child.stdin.write(pickle.dumps(share))
                child.stdin.close()
            except BrokenPipeError:
                pass
        return self

    def wait(self, index: int) -> None:
        """Until the model of this index has its kernel in the cache, or nobody works on it any more."""
        if not self._children:
            return
        which, wanted = index % len(self._children), index // len(self._children) + 1
        said = self._children[which].stdout
        assert said is not None
        while self._done[which] < wanted and said.readline():
            self._done[which] += 1

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for child in self._children:
            child.kill()
            child.wait()
            if child.stdout is not None:
                child.stdout.close()


def compile_kernel(model: Model) -> None:
    """Compile what ``engines.batch.simulate`` needs for a model's structure and force laws, or find it in the cache."""
    nj, na = len(model.morphology.joints), len(model.morphology.actuators)
    rest = np.zeros((1, na))
    trial = Trial("first", np.zeros(1), rest, rest[0], 0.0, np.full(nj, 0.5), np.array([0.0, 1e-3]))
    simulate([model], [trial], dt=1e-3, threads=1, check=False)


def _work() -> None:
    for model in pickle.load(sys.stdin.buffer):
        compile_kernel(model)
        sys.stdout.write("done\n")
        sys.stdout.flush()
