"""MuJoCo without its own words, in several threads."""

from __future__ import annotations

import threading

import mujoco

from equimus_ctrl.quiet import quietly


def test_mujoco_is_quiet_until_the_last_thread_has_left_and_heard_as_before_then() -> None:
    heard: list[str] = []
    before = mujoco.get_mju_user_warning()
    entered, leave = threading.Event(), threading.Event()

    def other() -> None:
        with quietly():
            entered.set()
            leave.wait(10)

    mujoco.set_mju_user_warning(heard.append)
    own = mujoco.get_mju_user_warning()
    try:
        thread = threading.Thread(target=other)
        with quietly():
            thread.start()
            assert entered.wait(10)
        assert mujoco.get_mju_user_warning() is not own
        leave.set()
        thread.join()
        assert mujoco.get_mju_user_warning() is own
    finally:
        mujoco.set_mju_user_warning(before)
