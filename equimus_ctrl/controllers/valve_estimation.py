"""Regulators that find out about their valves: what they are made of follows the likeliest hypothesis of a bank.

Weights that settings say were not looked at with what usually stands between a command and its force: with 0.1 s of
dead time and 0.1 s of lag that its model lacks, the leg's regulator swings. Those that ``controllers.allowances`` finds
are stable then, but lag behind a path, which is most of their error where servos hold their goals stiffly. So the
observer keeps a bank of valves, or drives, up to the usual ones (``estimation.valve_bank``), and once another is likely
beyond chance, observer, inverse and regulator are those of a model that has it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

from equimus_ctrl.estimation.observer import Observer, ObserverState
from equimus_ctrl.estimation.valve_bank import ValveBank
from equimus_ctrl.models.model import Model
from equimus_ctrl.settings import both
from equimus_ctrl.types import Observation, PlantSpec


class Observing(Protocol):
    """What is made for one hypothesis."""

    @property
    def observer(self) -> Observer: ...

    def taken_over(self, state: Any) -> dict[str, Any]:
        """The fields of a controller's state that other valves change."""
        ...


Tools = TypeVar("Tools", bound=Observing)


def bank_of(spec: PlantSpec, wanted: bool) -> ValveBank | None:
    """A bank for a robot; None where it is not wanted, or nothing can be later than is known."""
    if not wanted:
        return None
    bank = ValveBank(Model(spec.model, spec.effects, spec.phase))
    return bank if bank.is_open else None


@dataclass(frozen=True, eq=False)
class Looked(Generic[Tools]):
    """What is known at a control instant.

    Attributes:
        tools: those in force.
        observer: what their observer remembers.
        watched: what the observer with the bank does.
        changed: whether they have come into force just now.
    """

    tools: Tools
    observer: ObserverState
    watched: ObserverState
    changed: bool


class ValveEstimation(Generic[Tools]):
    """Tools for each hypothesis, made when it first comes into force.

    Args:
        spec: of the plant, with the model.
        known: tools of the model as it is known; their observer has a bank.
        make: of a spec whose model has other valves.
        said: of everything else, for a person to read.
    """

    def __init__(self, spec: PlantSpec, known: Tools, make: Callable[[PlantSpec], Tools], said: str = "") -> None:
        bank = known.observer.bank
        assert bank is not None
        self._spec, self._make, self._bank, self._observer = spec, make, bank, known.observer
        self._said = said
        self._made: dict[tuple[int, ...], Tools] = {(0,) * len(spec.actuators): known}

    def look(
        self, observation: Observation, tools: Tools, state: ObserverState, watched: ObserverState
    ) -> Looked[Tools]:
        """What is known after one more control instant.

        Args:
            observation: of it.
            tools: that were in force.
            state: what their observer remembers.
            watched: what the observer with the bank does.
        """
        after = self._observer.update(observation, watched)
        assert watched.bank is not None and after.bank is not None
        changed = after.bank.choice != watched.bank.choice
        if changed:
            tools = self._of(after.bank.choice)
        if tools.observer is self._observer:
            own = after
        elif changed:
            own = self._observer.others(after)
        else:
            own = tools.observer.update(observation, state)
        return Looked(tools, own, after, changed)

    def note(self, watched: ObserverState) -> str:
        """For a person: also by how much valves were found later than is known, where they were."""
        assert watched.bank is not None
        late = self._bank.late[range(len(self._spec.actuators)), list(watched.bank.choice)]
        words = "valves" if self._spec.model.traits.commands_are_pressures else "drives"
        found = []
        for name, times in zip(self._spec.actuators, late.tolist(), strict=True):
            parts = [f"{time:.3g} s of {what}" for time, what in zip(times, ("dead time", "lag"), strict=True) if time]
            found += [f"{name} by {' and '.join(parts)}"] if parts else []
        return both(self._said, f"{words} were found to be later than is known: {', '.join(found)}" if found else "")

    def _of(self, choice: tuple[int, ...]) -> Tools:
        if choice not in self._made:
            self._made[choice] = self._make(replace(self._spec, effects=self._bank.model(choice).effects))
        return self._made[choice]


@dataclass(frozen=True, eq=False)
class ObservedState:
    """What every controller on an observer carries from step to step.

    Attributes:
        observer: what is known of the robot.
        tools: made for the plant, and its valves, once.
        note: where acceptable deviations come from, or what was found of the valves; empty where settings say all.
        estimation: of valves; None where there is none.
        watched: what its observer remembers.
    """

    observer: ObserverState
    tools: Any
    note: str
    estimation: ValveEstimation[Any] | None
    watched: ObserverState | None


AnyState = TypeVar("AnyState", bound=ObservedState)


def found_out(observation: Observation, state: AnyState) -> AnyState:
    """With what is known of the robot now, and the tools for the likeliest valves."""
    if state.estimation is None or state.watched is None:
        return replace(state, observer=state.tools.observer.update(observation, state.observer))
    estimation = state.estimation
    found = estimation.look(observation, state.tools, state.observer, state.watched)
    state = replace(state, observer=found.observer, watched=found.watched)
    if not found.changed:
        return state
    return replace(state, tools=found.tools, note=estimation.note(found.watched), **found.tools.taken_over(state))
