"""A plugin of MuJoCo's viewer that plays a run; imported only where that viewer is there.

The viewer reads the types of a plugin's handlers, which therefore stand here as types, not as text.
"""

import time
from collections.abc import Callable
from typing import Any

from mujoco.studio import messages, sim, step_control

WAIT = 2e-3
"""Between two looks at the viewer [s]."""


class Playback(step_control.StepControl):  # type: ignore[misc,unused-ignore]
    """Poses of a run in the place of stepped physics, at the viewer's speed and with its pause.

    Args:
        put: puts data to where all is so long after the beginning [s].
    """

    def __init__(self, put: Callable[[Any, float], None]) -> None:
        super().__init__()
        self._put = put
        self.at, self._before = 0.0, time.perf_counter()

    @messages.handler(priority=messages.Priority.INTERNAL)  # type: ignore[untyped-decorator,unused-ignore]
    def _on_step(self, event: messages.StepEvent) -> None:
        now = time.perf_counter()
        passed, self._before = now - self._before, now
        if self.step_control.get_pause_state() == sim.PauseState.UNPAUSED:
            self.at += passed * self.step_control.get_speed() / 100
            self._put(event.data, self.at)
        time.sleep(WAIT)
