"""The environments that ``gymnasium.make`` knows."""

from __future__ import annotations

import contextlib

NAMESPACE = "equimus_ctrl"
KNOWN = ("kick", "hold", "track")
"""Tasks that have a name of their own there; ``eq.make_env`` takes every scenario."""


def name_of(task: str) -> str:
    """What a task is called there, such as ``equimus_ctrl/Kick-v0``."""
    return f"{NAMESPACE}/{task.capitalize()}-v0"


def register_environments() -> None:
    """Make them known, where Gymnasium is installed."""
    with contextlib.suppress(ImportError):
        from gymnasium.envs import registration

        for task in KNOWN:
            if name_of(task) not in registration.registry:
                registration.register(
                    name_of(task),
                    entry_point="equimus_ctrl.workflow.learning:make_env",
                    vector_entry_point="equimus_ctrl.workflow.learning:make_vec_env",
                    kwargs={"task": task},
                )
