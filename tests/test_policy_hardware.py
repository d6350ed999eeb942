"""A policy on a wire in memory: within the limits, and vented where it is not to go on."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing

import numpy as np
import pytest
from hardware_rig import MODEL, REST, MemoryWire, plant_on, still
from policy_cases import policy_for

from equimus_ctrl.errors import ConfigError, HardwareFault
from equimus_ctrl.learning.policy_controller import PolicyController
from equimus_ctrl.loop import run
from equimus_ctrl.scenarios.references import HoldReference
from equimus_ctrl.workflow.learning import make_episodes

pytestmark = pytest.mark.real_time


def controller(control: float | None = None) -> PolicyController:
    return PolicyController(policy_for(make_episodes("kick", 1, MODEL, control=control, threads=1), MODEL, 5))


def test_it_drives_a_robot_within_its_limits(wires: Callable[..., MemoryWire]) -> None:
    wire = wires()
    plant = plant_on(wire)
    with closing(plant):
        done = run(plant, controller(60.0), HoldReference(REST), 0.5)
    assert plant.counts.fault == "" and np.all(done.command >= 0) and np.all(done.command <= 50e3)
    assert len(np.unique(done.asked[:, 0])) > 5
    assert np.all(wire.pressures[-3:] == 0)


def test_what_it_must_not_see_vents(wires: Callable[..., MemoryWire]) -> None:
    wire = wires(lambda k, now: [still(now, (math.nan, 1.04) if k > 60 else REST)])
    plant = plant_on(wire)
    with closing(plant), pytest.raises(HardwareFault, match="hip was measured as nan"):
        run(plant, controller(), HoldReference(REST), 3.0)
    assert np.all(wire.pressures[-3:] == 0)


def test_a_policy_for_another_rate_never_moves_it(wires: Callable[..., MemoryWire]) -> None:
    wire = wires()
    plant = plant_on(wire)
    with closing(plant), pytest.raises(ConfigError, match="acts 80 times a second, this plant 120"):
        run(plant, controller(80.0), HoldReference(REST), 1.0)
    assert np.all(wire.pressures == 0)
