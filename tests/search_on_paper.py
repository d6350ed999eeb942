"""A search whose hypotheses have deviances that are given instead of simulated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from equimus_ctrl.diagnosis import confirmation
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchHistory, SearchState
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.effects import REGISTRY
from equimus_ctrl.errors import SimulationDiverged

VALUES: dict[str, dict[str, float]] = {
    "coulomb_friction": {"friction": 0.01},
    "stribeck_friction": {"friction": 0.01, "breakaway": 0.012, "velocity": 0.1},
    "dead_zone": {"threshold": 1e3},
    "saturation": {"level": 1e4},
    "sensor_offset": {"offset": 0.1},
}
RUB, STICK = "coulomb_friction:knee", "stribeck_friction:knee"
DEAD, FULL, OFF = "dead_zone:baa", "saturation:baa", "sensor_offset:hip"
POOL = {label: Candidate(REGISTRY[label.split(":")[0]], (label.split(":")[1],), (VALUES[label.split(":")[0]],))
        for label in (RUB, STICK, DEAD, FULL, OFF)}  # fmt: skip


def fitted(deviance: float, *labels: str) -> Fitted:
    parts = tuple(Part(POOL[label], VALUES[label.split(":")[0]]) for label in labels)
    fit: Any = SimpleNamespace(model=object(), residuals=[np.zeros((5, 2))], starts=[], theta=np.zeros(3))
    return Fitted(parts, fit, None, deviance)  # type: ignore[arg-type]


@dataclass
class Known:
    """Deviances of sets of effects."""

    of: Mapping[tuple[str, ...], float]
    outdone: Sequence[frozenset[str]] = ()
    aliased: Sequence[str] = ()
    same: Sequence[frozenset[str]] = ()
    lost: Sequence[str] = ()

    def __call__(self, *labels: str) -> Fitted:
        return self.fits[frozenset(labels)]

    def __post_init__(self) -> None:
        self.fits = {frozenset(labels): fitted(deviance, *labels) for labels, deviance in self.of.items()}


def not_simulated(*given: object, **options: object) -> Fitted:
    raise SimulationDiverged("on paper nothing is simulated")


class OnPaper(Search):
    """A search whose fits are looked up."""

    known: Known
    torque_domain = None

    def __init__(self, known: Known, settings: SearchSettings | None = None) -> None:
        free = SimpleNamespace(free=[], model=object())
        data: Any = SimpleNamespace(
            n=1000, free=free, thresholds=Thresholds(), strong=lambda f: False, far_above_noise=lambda f: False, converge=lambda f: f,
            base=lambda: known(), aliased=lambda f, k: f.hypothesis[k].candidate.label in known.aliased, may_be_nothing=lambda f, k: False,
            theta_of=lambda theta, hypothesis: theta, coarse_fit=not_simulated, dimensions=lambda f, k, most: most,
        )  # fmt: skip
        super().__init__(data, list(POOL.values()), settings or SearchSettings())
        object.__setattr__(self, "known", known)

    def refit(self, tried: SearchHistory, fitted: Fitted, hypothesis: tuple[Part, ...]) -> tuple[Fitted, SearchHistory]:
        found = self.known(*(part.candidate.label for part in hypothesis))
        return found, tried.having(found)

    def challenge(
        self, tried: SearchHistory, fitted: Fitted, instead_of: str = "", rival: Fitted | None = None
    ) -> tuple[list[Fitted], SearchHistory]:
        return [
            f
            for labels, f in self.known.fits.items()
            if labels > fitted.labels and len(labels) == len(fitted.labels) + 1
            if instead_of not in labels and tried.allows(f.candidates)
        ], tried

    def _beside_runners_up(self, state: SearchState) -> tuple[list[Fitted], SearchHistory]:
        return [], state.tried

    def _withholding(self, accepted: SearchState) -> Search:
        return self

    def _leaves_the_same(self, best: Fitted, other: Fitted) -> bool:
        return best.labels | other.labels in self.known.same

    def over_scatter(self, simple: Fitted, rich: Fitted, t: Thresholds) -> float:
        return 0.5 if (rich.labels - simple.labels) & set(self.known.lost) else 2.0

    def _outdone(self, best: Fitted, top: Fitted, force: Callable[[], float | None]) -> bool:
        return top.labels in self.known.outdone


def held_out_rejects(monkeypatch: pytest.MonkeyPatch, rejected: Sequence[tuple[frozenset[str], frozenset[str]]]) -> Any:
    """Held-out trials reject these steps from one set to another; a split."""

    def carried_over(search: Search, holdout: object, simple: Fitted, rich: Fitted) -> confirmation.Confirmation:
        return confirmation.Confirmation("gain", float((simple.labels, rich.labels) not in rejected))

    monkeypatch.setattr(confirmation, "HoldoutResiduals", lambda *a: None)
    monkeypatch.setattr(confirmation, "carried_over", carried_over)
    monkeypatch.setattr(confirmation, "_lost_in_scatter", lambda *given: None)
    monkeypatch.setattr(confirmation, "_makes_worse", lambda *given: None)
    return SimpleNamespace(validation=[1], train=(), short_segments=(), other=None)


def ended(known: Known, *labels: str) -> SearchState:
    """An end with these parts; alternatives are those with another in a part's place."""
    rest = [[other for other in labels if other != label] for label in labels]
    own = OnPaper(known)
    alternatives = tuple(
        tuple(own.challenge(SearchHistory(), known(*r), label)[0]) for r, label in zip(rest, labels, strict=True)
    )
    return SearchState(known(), known(*labels), tuple(known(*r) for r in rest), alternatives)
