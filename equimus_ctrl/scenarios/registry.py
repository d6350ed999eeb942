"""The scenarios known by name that no script of its own holds."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from equimus_ctrl.registry import Registry
from equimus_ctrl.scenarios.scenario import Scenario, ScenarioContext, build_scenario, option_defaults, takes_joints


@dataclass(frozen=True)
class ScenarioEntry:
    """A scenario known by name.

    Attributes:
        summary: one line for lists.
        build: makes it of a context; its keyword parameters, each with a default, are the scenario's options. It says
            what it needs: ``ScenarioContext.require`` a robot, ``ScenarioContext.recording`` what was recorded.
        where: where it stands, for messages.
        name: by which robots' descriptions know it.
    """

    summary: str
    build: Callable[..., Scenario]
    where: str = ""
    name: str = ""

    @property
    def options(self) -> dict[str, Any]:
        """Name → default of each option; ``JOINT`` where each joint of the robot is one."""
        joints = {"JOINT": "as in the keyframe"} if takes_joints(self.build) else {}
        return {**option_defaults(self.build), **joints}

    def scenario(self, context: ScenarioContext, options: Mapping[str, str] | None = None) -> Scenario:
        """The scenario with options given as text, see ``build_scenario``."""
        return build_scenario(self.build, context, options, self.where, self.name)


SCENARIOS: Registry[ScenarioEntry] = Registry("scenario")


def register_scenario(name: str, build: Callable[..., Scenario]) -> None:
    """Make a scenario known by a name, beside the scripts under ``scenarios/``; its docstring is what lists say.

    Args:
        name: a plain one.
        build: makes it of a ``ScenarioContext`` and of options by their names.

    Raises:
        ConfigError: where the name is another's or no plain name.
    """
    SCENARIOS.add(name, ScenarioEntry(first_paragraph(build), build, f"scenario {name}", name))


def first_paragraph(thing: object) -> str:
    """Of a docstring, as one line; empty where there is none."""
    return (inspect.getdoc(thing) or "").partition("\n\n")[0].replace("\n", " ")
