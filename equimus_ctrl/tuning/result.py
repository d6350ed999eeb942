"""What tuning a controller came to, and its record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from platform import python_version
from typing import Any, ClassVar

from equimus_ctrl.controllers.pid_settings import PidSettings
from equimus_ctrl.models.model import model_to_dict
from equimus_ctrl.tuning.objective import Evaluation
from equimus_ctrl.tuning.search import Trial
from equimus_ctrl.tuning.stability import Margins
from equimus_ctrl.tuning.study import Study
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


@dataclass(frozen=True, eq=False)
class TuningResult:
    """What a study found.

    Attributes:
        study: the study.
        problem: what candidates were judged by.
        history: every candidate, in order.
        best: the result.
        settings: its gains.
        start: the gains the search began with.
        start_evaluation: what those were worth.
        unseen: the result on robots that took no part in the tuning.
        start_unseen: the first gains on the same.
        interrupted: whether the search was stopped before its budget was spent.
        margins: of the result on the model itself, at the first objective's last pose; none where its loops have none.
        least_margins: least gain, phase and delay margin over every robot and pose.
        checks: the result on the MuJoCo plant, where candidates were judged by another engine.
    """

    schema: ClassVar[str] = "equimus-ctrl/tuning-record/1"
    robots: ClassVar[str] = "legs"
    study: Study
    problem: Any
    history: list[Trial]
    best: Trial
    settings: PidSettings
    start: PidSettings
    start_evaluation: Evaluation
    unseen: list[Evaluation]
    start_unseen: list[Evaluation]
    interrupted: bool
    margins: Sequence[Margins] = ()
    least_margins: Sequence[Margins] = ()
    checks: Sequence[CrossCheck] = ()

    def record(self) -> dict[str, Any]:
        """Everything worth keeping, in plain types."""
        joints = self.problem.model.robot.joint_names
        return {
            "schema": self.schema,
            "seed": self.study.seed,
            "versions": versions(),
            "study": asdict(self.study),
            "model": model_to_dict(self.problem.model),
            "interrupted": self.interrupted,
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
                "start_stable": sum(e.stable for e in self.start_unseen),
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
