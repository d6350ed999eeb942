"""What tuning a controller came to, and its record."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from platform import python_version
from typing import Any, ClassVar

import numpy as np

from equimus_ctrl.executors.versions import processor
from equimus_ctrl.models.model import model_to_dict
from equimus_ctrl.shown import Short
from equimus_ctrl.tuning.evaluation import Evaluation
from equimus_ctrl.tuning.search import Trial
from equimus_ctrl.tuning.stability import Margins
from equimus_ctrl.tuning.study import AnyStudy
from equimus_ctrl.types import Array

LIBRARIES = ("equimus-ctrl", "numpy", "scipy", "numba", "casadi", "mujoco", "cmaes", "control")


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    found = {"python": python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except Exception:
            found[name] = "unknown"
    return found


@dataclass(frozen=True, eq=False)
class CrossCheck:
    """The tuned loop on the MuJoCo plant beside the compiled one, noise included.

    Attributes:
        scenario: which.
        rmse: (nj,) tracking error on the MuJoCo plant [rad].
        difference: largest difference between the two engines' angles [rad].
    """

    scenario: str
    rmse: Array
    difference: float


def summed(found: Sequence[Evaluation]) -> dict[str, float]:
    """Median and worst of what one set of numbers costs on single robots, beyond limits or not.

    One that is not stable costs more than any that is: infinite, which JSON has as null.
    """
    costs = [e.member_costs[0] if e.stable else math.inf for e in found]
    return {"median": float(np.median(costs)), "worst": max(costs)} if costs else {}


@dataclass(frozen=True, eq=False, repr=False)
class TuningResult(Short):
    """What a study found.

    Attributes:
        study: the study.
        problem: what candidates were judged by.
        history: every candidate, in order.
        best: the result.
        settings: its settings, which ``to_dict`` makes what their file holds.
        start: those that the search began with.
        start_evaluation: what those were worth.
        unseen: the result on robots that took no part in the tuning.
        start_unseen: the first gains on the same.
        interrupted: whether the search was stopped before its budget was spent.
        margins: of the result on the model itself, at the first objective's last pose; none where its loops have none.
        least_margins: least gain, phase and delay margin over every robot and pose.
        checks: the result on the MuJoCo plant, where candidates were judged by another engine.
        timed_out: whether the search ended because its time was up.
    """

    schema: ClassVar[str] = "equimus-ctrl/tuning-record/1"
    robots: ClassVar[str] = "legs"
    noun: ClassVar[str] = "sets of gains"
    member: ClassVar[str] = "leg"
    study: AnyStudy
    problem: Any
    history: list[Trial]
    best: Trial
    settings: Any
    start: Any
    start_evaluation: Evaluation
    unseen: list[Evaluation]
    start_unseen: list[Evaluation]
    interrupted: bool
    margins: Sequence[Margins] = ()
    least_margins: Sequence[Margins] = ()
    checks: Sequence[CrossCheck] = ()
    timed_out: bool = False

    @property
    def heading(self) -> str:
        """What the settings file begins with."""
        return f"PID gains, in {'N and m' if self.settings.space == 'length' else 'N·m and rad'}"

    def found(self) -> tuple[str, tuple[str, ...], list[tuple[Any, ...]]]:
        """What was found as a table for people: its title, the heads of its columns, its rows."""
        rows = [(channel, g.kp, g.ki, g.kd) for channel, g in self.settings.gains.items()]
        return f"Gains ({self.settings.space})", ("channel", "kp", "ki", "kd"), rows

    def record(self) -> dict[str, Any]:
        """Everything worth keeping, in plain types."""
        joints = self.problem.model.robot.joint_names
        return {
            "schema": self.schema,
            "seed": self.study.seed,
            "versions": versions(),
            "processor": processor(),
            "study": asdict(self.study),
            "model": model_to_dict(self.problem.model),
            "interrupted": self.interrupted,
            "timed_out": self.timed_out,
            "evaluated": len(self.history),
            "settings": self.settings.to_dict(),
            "best": self.best.to_dict(),
            "start": {"settings": self.start.to_dict(), **self.start_evaluation.to_dict()},
            "margins": [m.to_dict() for m in self.margins],
            "least_margins": [m.to_dict() for m in self.least_margins],
            "unseen": {
                self.robots: len(self.unseen),
                "stable": sum(e.stable for e in self.unseen),
                "feasible": sum(e.feasible for e in self.unseen),
                "costs": [e.cost for e in self.unseen],
                **summed(self.unseen),
                "start_stable": sum(e.stable for e in self.start_unseen),
                **{f"start_{key}": value for key, value in summed(self.start_unseen).items()},
            },
            "mujoco": [
                {
                    "scenario": c.scenario,
                    "rmse_rad": dict(zip(joints, map(float, c.rmse), strict=True)),
                    "largest_difference_rad": c.difference,
                }
                for c in self.checks
            ],
            "evaluations": [trial.to_dict() for trial in self.history],
        }
