"""The contract test that users call: what keeps it passes, what breaks it is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import equimus_ctrl as eq
from equimus_ctrl import presets
from equimus_ctrl.controllers.lqr import LqrController
from equimus_ctrl.controllers.nmpc import NmpcController, NmpcSettings
from equimus_ctrl.controllers.open_loop import OpenLoopController
from equimus_ctrl.controllers.sampling import SamplingController
from equimus_ctrl.controllers.sampling_settings import SamplingSettings
from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.types import Observation, PlantSpec, Reference


class Base:
    def init(self, spec: PlantSpec, observation: Observation) -> int:
        return 0

    def step(self, observation: Observation, reference: Reference, state: int) -> tuple[object, int]:
        return np.full(2, 1e4 + state), state + 1


class Remembers(Base):
    """What evolves is hidden in the controller."""

    count = 0

    def step(self, observation: Observation, reference: Reference, state: int) -> tuple[object, int]:
        self.count += 1
        return np.full(2, 1e4 + self.count), state


class Draws(Base):
    def init(self, spec: PlantSpec, observation: Observation) -> int:
        self.offset = getattr(self, "offset", 0) + 1
        return 0

    def step(self, observation: Observation, reference: Reference, state: int) -> tuple[object, int]:
        return np.full(2, 1e4 + (self.offset if state > 5 else 0)), state + 1


class Fails(Base):
    def step(self, observation: Observation, reference: Reference, state: int) -> tuple[object, int]:
        if not np.all(np.isfinite(observation.position)):
            raise ValueError("no number")
        return super().step(observation, reference, state)


class Tells(Base):
    def step(self, observation: Observation, reference: Reference, state: int) -> tuple[object, int]:
        if not np.all(np.isfinite(observation.position)):
            raise ControllerError("a sensor is silent")
        return super().step(observation, reference, state)


class Alone(Base):
    def step(self, observation: Observation, reference: Reference, state: int) -> object:  # type: ignore[override]
        return np.zeros(2)


class Short(Base):
    def step(self, observation: Observation, reference: Reference, state: int) -> tuple[object, int]:
        return np.zeros(1), state


class Wild(Base):
    def step(self, observation: Observation, reference: Reference, state: int) -> tuple[object, int]:
        return np.array([6e4, 1e4]), state


def test_what_keeps_the_contract_passes() -> None:
    report = eq.testing.check_controller(Base, steps=20)
    assert report.name == "Base" and report.notes == () and len(report.kept) == 4
    assert 0 < report.step_time[0] <= report.step_time[1]


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (Remembers, "Remembers: asked again with the state of 0.000 s it commands"),
        (Draws, r"Draws: begun anew it commands \(10.002, 10.002\) instead of \(10.001, 10.001\) kPa at 0.050 s"),
        (Fails, "Fails with a measurement that is no number: Fails.step at .* s fails: ValueError: no number"),
        (Alone, r"Alone.step returned .* expected \(command, state\)"),
        (Short, r"Short returned a command of shape \(1,\) at 0.000 s"),
        (dict, "dict"),
    ],
)
def test_what_breaks_it_is_named(broken: type, message: str) -> None:
    with pytest.raises(ControllerError, match=message):
        eq.testing.check_controller(broken, steps=20)


def test_what_may_be_meant_is_noted() -> None:
    assert eq.testing.check_controller(Tells, steps=20).notes == (
        "a measurement that is no number is an error: a sensor is silent",
    )
    assert eq.testing.check_controller(Wild, steps=20).notes == (
        "50 % of its commands lie outside the limits and are clipped",
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pid", "lqr", "nmpc", "sampling", "open_loop", "Spring", "spring"])
def test_our_own_keep_it(name: str) -> None:
    example = f"{presets.workspace() / 'controllers' / 'example_custom.py'}:{name}"
    made = {
        "pid": lambda: eq.PidController(eq.PidSettings.from_dict(presets.read_toml(Path("controllers/pid.toml")))),
        "lqr": LqrController,
        "nmpc": lambda: NmpcController(NmpcSettings(compiled=False)),
        "sampling": lambda: SamplingController(SamplingSettings(compiled=False)),
        "open_loop": lambda: OpenLoopController(None),
    }
    controller = made[name]() if name in made else presets.load_object(example)
    report = eq.testing.check_controller(controller, steps=20)
    assert len(report.kept) == 4


def test_too_few_steps() -> None:
    with pytest.raises(ConfigError, match="steps is 3, expected at least 10"):
        eq.testing.check_controller(Base, steps=3)
