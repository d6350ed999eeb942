"""One designed trial, by a process that knows what a diagnosis leaves, and nothing else of the robot."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from equimus_ctrl.computer import keep_freed_memory
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.errors import EquimusError, NotAvailable, one_line
from equimus_ctrl.experiments.conditions import KnownCondition
from equimus_ctrl.experiments.design import LIMIT_DRAWS, designed
from equimus_ctrl.experiments.limits import Limits
from equimus_ctrl.experiments.loop import Predicted, fitted_share, worth_making
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof.blind import as_text
from equimus_ctrl.proof.fingerprint import PARTS, fingerprint

End = Literal["resolved", "inseparable", "none", "failed"]
"""Why a case has no further trial: one explanation is left, beside which nothing more can be seen; nothing more can be
distinguished within the limits; no trial could be designed, for the robot rests nowhere or nothing that moves it keeps
the limits; or something failed."""
SEEDS = 2**20
"""Seeds of searches are below that."""


@dataclass(frozen=True, eq=False)
class Designing:
    """How trials are designed.

    Attributes:
        limits: that they keep, with their duration.
        evaluations: of designs; as many as usual by default.
        draws: of each rival's parameters through which the design is taken.
        conditions: known ones that can be had.
    """

    limits: Limits
    evaluations: int | None = None
    draws: int = LIMIT_DRAWS
    conditions: tuple[KnownCondition, ...] = (KnownCondition(),)

    @property
    def fingerprint(self) -> str:
        """By what a design is made: code, limits and settings."""
        own = {
            f.name: value.tolist() if isinstance(value := getattr(self.limits, f.name), np.ndarray) else value
            for f in fields(Limits)
            if f.name != "robot"
        }
        return fingerprint(
            repr((own, self.evaluations, self.draws, [c.text for c in self.conditions])), (*PARTS, "experiments")
        )


@dataclass(frozen=True, eq=False)
class Design:
    """A trial that is to be made, or why there is none.

    Attributes:
        commands: of it; None where there is none.
        predicted: what it is expected to distinguish.
        rate: of the recordings so far [1/s].
        notes: that recordings of it have to have, see ``Rivals.notes``.
        alone: whether one explanation is left but for what may hide beside it.
        end: why there is none by itself, see ``End``; None where there is one.
        said: the same as a sentence.
        seconds: that the design took.
    """

    commands: Commands | None
    predicted: tuple[Predicted, ...]
    rate: float
    notes: Mapping[str, str]
    alone: bool
    end: End | None
    said: str
    seconds: float

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Design:
        """What ``next_trial`` wrote down."""
        own = data["commands"]
        commands = None
        if own is not None:
            start = None if own["start"] is None else np.array(own["start"])
            commands = Commands(
                np.array(own["times"]), np.array(own["commands"]), own["duration_s"], start, own["notes"]
            )
        predicted = tuple(Predicted.from_dict(pair) for pair in data["predicted"])
        rate, notes, alone = data["rate_hz"], data["notes"], data["alone"]
        return cls(commands, predicted, rate, notes, alone, data["end"], data["said"], data["proof"]["seconds"])

    def ends(self, left: int) -> End | None:
        """Why no trial is made; None where one is.

        Args:
            left: how many trials there may yet be.
        """
        if self.end is not None or self.commands is None:
            return self.end or "none"
        if worth_making(self.predicted, left):
            return None
        return "resolved" if self.alone else "inseparable"


def next_trial(
    left: Mapping[str, Any], model: Model, designing: Designing, case: int, number: int, made: Mapping[str, Any]
) -> str:
    """The trial that distinguishes best what a diagnosis leaves, as a file holds it.

    Args:
        left: the rivals, see ``Rivals.to_dict``.
        model: what the robot is taken to be.
        designing: how.
        case: number of the case; with the trial's it gives the seed of the search.
        number: of the trial, from 1 on.
        made: written down too: what the design is of.
    """
    begun, processor = time.perf_counter(), time.process_time()
    keep_freed_memory()
    rivals = Rivals.from_dict(left, model)
    found: dict[str, Any] = {
        "end": None, "said": "", "commands": None, "predicted": [], "rate_hz": rivals.rate, "notes": rivals.notes,
        "alone": len(rivals.named) == 1,
    }  # fmt: skip
    if len(rivals.rivals) == 1:
        found |= {"end": "resolved", "said": f"one explanation is left: {rivals.rivals[0].label}"}
    else:
        seed = int(np.random.SeedSequence([case, number]).generate_state(1)[0]) % SEEDS
        try:
            own = designed(
                replace(rivals, fitted=fitted_share()), designing.limits, seed=seed, evaluations=designing.evaluations,
                draws=designing.draws, conditions=designing.conditions, simulator=rivals.simulator(1),
            )  # fmt: skip
            if own.commands.law is not None:
                raise NotAvailable(f"{model.robot.name} rests under no constant command; proofs make no tracked trials")
            found |= {
                "commands": {
                    "times": own.commands.times.tolist(),
                    "commands": own.commands.commands.tolist(),
                    "duration_s": own.commands.duration,
                    "start": None if own.commands.start is None else own.commands.start.tolist(),
                    "notes": dict(own.commands.notes),
                },
                "predicted": [pair.to_dict() for pair in Predicted.of(rivals, own.pairs)],
                "design": own.to_dict(),
            }
        except EquimusError as error:
            found |= {"end": "none", "said": one_line(str(error))}
        except Exception as error:  # a proof counts failures; it does not end with one
            found |= {"end": "failed", "said": one_line(f"{type(error).__name__}: {error}")}
    spent = {"seconds": time.perf_counter() - begun, "cpu_seconds": time.process_time() - processor}
    return as_text({**found, "proof": {**spent, **made, "fingerprint": designing.fingerprint}})
