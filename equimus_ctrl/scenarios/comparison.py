"""What a comparison of controllers came to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from equimus_ctrl.frames import dataframe
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.reading import by_unit
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.scenarios.scoring import ErrorFigures, Score
from equimus_ctrl.shown import Short, by_name, counted
from equimus_ctrl.types import Array, Run

if TYPE_CHECKING:
    from pandas import DataFrame

SCHEMA = "equimus-ctrl/comparison/1"


@dataclass(frozen=True, eq=False, repr=False)
class Condition(Short):
    """A robot, and what its controllers know of it.

    Attributes:
        name: for tables.
        summary: one line.
        model: what is simulated.
        known: what controllers may compute with.
        noise: standard deviation of measured angles [rad].
    """

    name: str
    summary: str
    model: Model
    known: Model
    noise: float


@dataclass(frozen=True, eq=False, repr=False)
class Entry(Short):
    """One controller in one scenario under one condition.

    Attributes:
        controller: its name.
        scenario: its name.
        condition: its name.
        run: what happened, or None where it ended early.
        score: how well, or None.
        error: figures of the true angles against the reference, or None.
        missed: share of steps that took longer than a control period.
        fallbacks: share of commands that no solution of their instant stands behind.
        failure: why it ended early; empty where it did not.
    """

    controller: str
    scenario: str
    condition: str
    run: Run | None
    score: Score | None
    error: ErrorFigures | None
    missed: float
    fallbacks: float
    failure: str = ""

    def told(self) -> str:
        """What was driven, and its error."""
        if self.error is None or self.run is None:
            return f" {self.controller}, {self.scenario}, {self.condition}: {self.failure}"
        error = by_name(self.run.spec.joints, self.error.rmse)
        return f" {self.controller}, {self.scenario}, {self.condition}: RMSE {error} rad or m"

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, SI units."""
        named = {"controller": self.controller, "scenario": self.scenario, "condition": self.condition}
        if self.run is None or self.score is None or self.error is None:
            return {**named, "failure": self.failure}
        spec, score = self.run.spec, self.score

        def table(what: str, values: Array) -> dict[str, dict[str, float]]:
            return by_unit(what, spec.joints, spec.joint_units, values)

        return {
            **named,
            **table("rmse", self.error.rmse),
            **table("max_abs", self.error.largest),
            **table("measured_rmse", score.tracking.rmse),
            **by_unit("effort", spec.actuators, spec.command_units, score.effort),
            "saturated_share": score.saturated,
            "solve_time_s": {"p50": score.solve_time[0], "p99": score.solve_time[1]},
            "deadline_missed_share": self.missed,
            "fallback_share": self.fallbacks,
            "window_s": list(score.window),
            "failure": None,
        }


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Short):
    """All entries.

    Attributes:
        model: the robot as it is known.
        scenarios: name → scenario.
        conditions: as they were.
        entries: scenario by scenario, condition by condition, controller by controller.
        seed: of noise and perturbed robots.
    """

    model: Model
    scenarios: Mapping[str, Scenario]
    conditions: tuple[Condition, ...]
    entries: tuple[Entry, ...]
    seed: int

    def told(self) -> str:
        """What was compared."""
        controllers = dict.fromkeys(entry.controller for entry in self.entries)
        return (
            f" on {self.model.name}: {', '.join(controllers)} in {', '.join(self.scenarios)} under "
            f"{counted(len(self.conditions), 'condition')}"
            + (f", {len(self.failures)} failed" if self.failures else "")
        )

    def to_dataframe(self) -> DataFrame:
        """A row for each entry: RMSE of each joint's true position [rad or m], largest error, what else is counted.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        joints, rows = self.model.robot.joint_names, []
        for own in self.entries:
            row: dict[str, Any] = {
                "scenario": own.scenario,
                "condition": own.condition,
                "controller": own.controller,
                "failure": own.failure,
            }
            if own.error is not None and own.score is not None:
                row |= {f"rmse.{j}": v for j, v in zip(joints, own.error.rmse.tolist(), strict=True)}
                row |= {f"largest.{j}": v for j, v in zip(joints, own.error.largest.tolist(), strict=True)}
                row |= {"saturated": own.score.saturated, "missed": own.missed, "fallbacks": own.fallbacks}
            rows.append(row)
        return dataframe(rows)

    @property
    def failures(self) -> tuple[Entry, ...]:
        """Those that ended early."""
        return tuple(entry for entry in self.entries if entry.failure)

    def to_dict(self) -> dict[str, Any]:
        """What ``compare --json`` prints."""
        return {
            "schema": SCHEMA,
            "model": self.model.name,
            "seed": self.seed,
            "conditions": {c.name: c.summary for c in self.conditions},
            "entries": [entry.to_dict() for entry in self.entries],
        }
