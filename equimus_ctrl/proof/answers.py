"""Truths and answers made comparable: which effects at which places, and on which joints forces act."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from equimus_ctrl.effects.base import REGISTRY, Effect
from equimus_ctrl.robots.base import Robot

STRONG = 0.3
"""Excess from which on an effect is to be found."""
EDGES = (0.03, 0.3, 3.0, 30.0)
BINS = (
    f"below {EDGES[0]:g}",
    *(f"{low:g} to {high:g}" for low, high in itertools.pairwise(EDGES)),
    f"above {EDGES[-1]:g}",
)
"""Names of ranges of the excess."""

Parts = Mapping[str, frozenset[str]]
"""Effect → all places where it acts."""
Method = str
"""``diagnosis`` or the name of a baseline."""
OURS = "diagnosis"


def bin_of(excess: float) -> str:
    """The range of ``BINS`` that an excess lies in."""
    return BINS[int(np.searchsorted(EDGES, excess, side="right"))]


@dataclass(frozen=True, eq=False)
class Places:
    """The places of a robot.

    Attributes:
        foot: the link whose tip is the foot; "" where it has none.
        joints: place → the joints on which a force there acts.
    """

    foot: str
    joints: Mapping[str, frozenset[str]]

    @classmethod
    def of(cls, robot: Robot) -> Places:
        """Of a robot; where a joint and its actuator have one name, it is the joint's."""
        names, places = robot.joint_names, robot.places()
        joints_of = {place: frozenset(names) for kind in ("link", "foot", "base") for place in places[kind]}
        joints_of |= {actuator: robot.driven_joints(actuator) for actuator in robot.actuator_names}
        joints_of |= {name: frozenset({name}) for name in names}
        return cls(robot.foot_link or "", joints_of)

    def same(self, location: str) -> str:
        """The one name of a place: the tip of the last link is the foot."""
        return "foot" if location == self.foot else location

    def joints_of(self, locations: Iterable[str]) -> frozenset[str]:
        """The joints on which forces at some places act."""
        return frozenset().union(*(self.joints[location] for location in locations))

    def parts(self, findings: Iterable[Mapping[str, Any]]) -> dict[str, frozenset[str]]:
        """Which effects act where; one effect found at two places separately is the same as in both together."""
        found: dict[str, frozenset[str]] = {}
        for finding in findings:
            effect, where = self.key(finding)
            found[effect] = found.get(effect, frozenset()) | where
        return found

    def key(self, named: Mapping[str, Any]) -> tuple[str, frozenset[str]]:
        """An effect and its places, comparable."""
        return named["effect"], frozenset(self.same(location) for location in named["locations"])

    def in_group(self, wanted: Parts, findings: Sequence[Mapping[str, Any]]) -> bool:
        """Whether findings are right, each by itself or by one that is not distinguishable from it.

        A law that is the sum of others is the same as these, see ``Effect.as_sum``.
        """
        if self.parts(findings) == dict(wanted) or _summands(self.parts(findings)) == _summands(wanted):
            return True
        options = [{self.key(f), *(self.key(e) for e in f.get("equivalent", ()))} for f in findings]
        if len(options) != len(wanted):
            return False
        orders = itertools.permutations(wanted.items())
        return any(all(key in own for key, own in zip(order, options, strict=True)) for order in orders)


def _too_small(true: Mapping[str, Any], detectable: float | None) -> bool:
    """Whether an effect is no larger than the smallest detectable size of it; None where it was seen at none."""
    if detectable is None:
        return True
    law = REGISTRY[true["effect"]]
    size, nothing = float(true["parameters"][next(iter(law.parameter_info()))]), law.grows_from()
    # Where no value does nothing, what is detectable is a value of it, not how far that is from one.
    return _is_weaker(law, size, detectable) if nothing is None else abs(size - nothing) <= detectable


def _is_weaker(law: type[Effect], one: float, other: float) -> bool:
    """Whether a value of a law's first parameter, none of which does nothing, certainly does no more than another."""
    return law.weaker != 0 and law.weaker * (one - other) >= 0


def _summands(parts: Parts) -> dict[str, frozenset[str]]:
    """The same with the effects of which a law is the sum in its place."""
    found: dict[str, frozenset[str]] = {}
    for effect, where in parts.items():
        law = REGISTRY[effect]
        for name in law.as_sum(dict.fromkeys(law.parameter_info(), 0.0)) or (effect,):
            found[name] = found.get(name, frozenset()) | where
    return found


@dataclass(frozen=True, eq=False)
class Answer:
    """What one method said of one case.

    Attributes:
        findings: as in a diagnosis report: effect, locations, parameters.
        unexplained: as in a diagnosis report; no baseline has any.
        failed: what went wrong, "" where nothing did.
    """

    findings: tuple[Mapping[str, Any], ...]
    unexplained: tuple[Mapping[str, Any], ...] = ()
    failed: str = ""

    @property
    def silent(self) -> bool:
        """Whether it said that nothing is missing."""
        return not (self.findings or self.unexplained or self.failed)


@dataclass(frozen=True, eq=False)
class Case:
    """One case with its seal opened.

    Attributes:
        truth: see ``store.truth_of``.
        report: of the diagnosis.
        baselines: name → answer as JSON.
        places: of the robot.
    """

    truth: Mapping[str, Any]
    report: Mapping[str, Any]
    baselines: Mapping[Method, Mapping[str, Any]]
    places: Places

    @property
    def number(self) -> int:
        """Of the case."""
        return int(self.truth["case"])

    @property
    def kind(self) -> str:
        """One of ``drawing.Kind``."""
        return str(self.truth["kind"])

    @property
    def coloured(self) -> bool:
        """Whether the noise is."""
        return float(self.truth["noise_correlation_s"]) > 0

    @property
    def strength(self) -> float:
        """The excess; in a pair that of the weaker one alone."""
        alone = [float(f["alone"]) for f in self.truth["findings"]]
        return min(alone) if alone else float(self.truth["excess"])

    @property
    def missing(self) -> list[Mapping[str, Any]]:
        """All that is missing from the nominal model, from the catalogue and from outside it."""
        return [*self.truth["findings"], *self.truth["outside"]]

    @property
    def wanted(self) -> Parts:
        """What ought to be found."""
        return self.places.parts(self.truth["findings"])

    @property
    def methods(self) -> tuple[Method, ...]:
        """Whose answers there are."""
        return (OURS, *self.baselines)

    def answer(self, method: Method) -> Answer:
        """What a method said."""
        if method == OURS:
            failed = self.report["proof"].get("failed") or ""
            left = (*self.report.get("unexplained", ()), *map(self._nameless, self.report.get("undetermined", ())))
            return Answer(tuple(self.report.get("findings", ())), left, failed)
        own = self.baselines[method]
        return Answer(tuple(own.get("findings", ())), failed=own.get("failed") or "")

    def _nameless(self, undetermined: Mapping[str, Any]) -> Mapping[str, Any]:
        """What fits but is not identifiable, as something left unexplained at its joints."""
        places = undetermined["locations"]
        joints = sorted(self.places.joints_of(places)) or list(places)
        return {"location": joints[0], "acts_at": list(places)}

    def named(self, method: Method) -> dict[str, frozenset[str]]:
        """The effects that a method named, with their places."""
        return self.places.parts(self.answer(method).findings)

    def exact(self, method: Method) -> bool:
        """Whether exactly what is there was named, in its places."""
        return not self.answer(method).failed and self.named(method) == self.wanted

    def in_group(self, method: Method) -> bool:
        """The same, or what the method calls not distinguishable from it."""
        answer = self.answer(method)
        return not answer.failed and self.places.in_group(self.wanted, answer.findings)

    def right(self, method: Method) -> bool:
        """Whether exactly what is there was said: nothing, these effects in their places, or something unexplained.

        What has no name has to be put where it acts.
        """
        if self.kind == "none":
            return self.answer(method).silent
        if self.kind == "outside":
            return self.unexplained(method) and self.placed(method)
        return self.exact(method)

    def among_left(self) -> bool:
        """Whether the diagnosis tells what is there among what it does not distinguish.

        Either each effect by one that it calls not distinguishable from it, or as one of the explanations that it
        leaves. Where it names nothing, it tells no effect, whatever would not have been seen.
        """
        answer = self.answer(OURS)
        if answer.failed or answer.silent or self.kind == "outside":
            return False
        return self._among_left(self.wanted)

    def but_for_unseen(self) -> bool:
        """Whether the diagnosis is right but for what it says that it would not have seen.

        That is each effect of no more than the smallest detectable size that the diagnosis tells of it there. The
        others are what it names, or among what it does not distinguish. Or what is there is an explanation that it does
        not exclude, at no more than the size that it gives.
        """
        answer, places = self.answer(OURS), self.places
        if answer.failed or answer.unexplained or self.truth["outside"]:
            return False
        left = self.report.get("rivals", {}).get("explanations", ())
        if any(own.get("given") and self._within(own) for own in left):
            return True
        sizes = {places.key(own): own["size"] for own in self.report.get("detectable", ())}
        seen = [own for own in self.truth["findings"] if not _too_small(own, sizes.get(places.key(own), 0.0))]
        if len(seen) == len(self.truth["findings"]):
            return False
        return places.parts(answer.findings) == places.parts(seen) or self._among_left(places.parts(seen))

    def _within(self, explanation: Mapping[str, Any]) -> bool:
        """Whether what is there is an explanation of a given size, or a smaller one."""
        if _summands(self.places.parts(explanation["effects"])) != _summands(self.wanted):
            return False
        law, key = explanation["effects"][-1]["effect"], explanation["given"][0].rpartition(".")[2]
        (given, *_) = [own[key] for own in explanation["model"]["effects"] if own["effect"] == law]
        (true, *_) = [own for own in self.truth["findings"] if own["effect"] == law]
        is_size = key == next(iter(REGISTRY[law].parameter_info()))
        value, nothing = true["parameters"][key], REGISTRY[law].grows_from() if is_size else 0.0
        if nothing is None:
            return _is_weaker(REGISTRY[law], value, given)
        return bool(abs(value - nothing) <= abs(given - nothing))

    def _among_left(self, wanted: Parts) -> bool:
        left = self.report.get("rivals", {}).get("explanations", ())
        possible = [own for own in left if own["accepted"] and not own.get("given")]
        return self.places.in_group(wanted, self.answer(OURS).findings) or any(
            _summands(self.places.parts(own["effects"])) == _summands(wanted) for own in possible
        )

    def unexplained(self, method: Method) -> bool:
        """Whether it was said that something is missing that has no name."""
        answer = self.answer(method)
        return bool(answer.unexplained) and not answer.findings

    def placed(self, method: Method) -> bool:
        """Whether the first thing left unexplained is put where the physics from outside acts."""
        left = self.answer(method).unexplained
        if not left:
            return False
        places = {location for e in self.truth["outside"] for location in e["locations"]}
        joints = self.places.joints_of(places)
        return left[0]["location"] in joints or bool(set(left[0].get("acts_at", ())) & (joints | places))
