"""Every effect of the catalogue, at every kind of place: the reduced engine and a plant in MuJoCo tell the same."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from equimus_ctrl.controllers.pid import PidController, PidGains, PidSettings
from equimus_ctrl.effects import Effect, catalogue, make
from equimus_ctrl.engines.predict import predict
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import Phase
from equimus_ctrl.scenarios.references import HoldReference
from equimus_ctrl.simulate import run
from equimus_ctrl.types import Array, Recording, Start

CATALOGUE = {
    "transport_delay", "first_order_lag", "asymmetric_lag", "rate_limit", "filling_flow", "dead_zone", "saturation",
    "supply_coupling", "cutoff",
    "coulomb_friction", "stribeck_friction", "hysteresis", "creep", "narrowing_area", "nonlinear_stiffness",
    "parallel_spring", "joint_stop", "backlash", "payload_mass", "gravity_tilt", "sensor_offset", "sensor_scale", "sensor_delay",
}  # fmt: skip

STRONG: dict[tuple[str, str], dict[str, float]] = {
    ("asymmetric_lag", "actuator"): {"fill": 0.2, "vent": 0.05},
    ("backlash", "joint"): {"play": 0.08},
    ("coulomb_friction", "actuator"): {"friction": 2.0},
    ("coulomb_friction", "joint"): {"friction": 0.1},
    ("creep", "actuator"): {"stiffness": 150.0, "time_constant": 0.2},
    ("cutoff", "actuator"): {"least": 6e3},
    ("dead_zone", "actuator"): {"threshold": 3e3},
    ("filling_flow", "actuator"): {"rate": 1.2e4, "power": 1.5},
    ("first_order_lag", "actuator"): {"time_constant": 0.2},
    ("gravity_tilt", "base"): {"angle": 0.2},
    ("hysteresis", "actuator"): {"size": 2.0, "width": 0.01},
    ("joint_stop", "joint"): {"angle": 0.65, "stiffness": 20.0, "damping": 0.05},
    ("narrowing_area", "actuator"): {"loss": 1.0},
    ("nonlinear_stiffness", "actuator"): {"cubic": 2e4, "centre": 0.2},
    ("parallel_spring", "joint"): {"stiffness": 2.0, "rest": 1.0},
    ("payload_mass", "foot"): {"mass": 0.15},
    ("payload_mass", "link"): {"mass": 0.3},
    ("rate_limit", "actuator"): {"rate": 2e4},
    ("saturation", "actuator"): {"level": 6e3},
    ("sensor_delay", "joint"): {"delay": 0.11},
    ("sensor_offset", "joint"): {"offset": 0.1},
    ("sensor_scale", "joint"): {"scale": 1.3},
    ("stribeck_friction", "joint"): {"friction": 0.04, "breakaway": 0.06, "velocity": 0.5},
    ("supply_coupling", "actuator"): {"share": 0.5},
    ("transport_delay", "actuator"): {"delay": 0.123},
}
"""Of every effect at every kind of place, numbers with which nobody could overlook it."""

IN_STANCE: dict[str, dict[str, float]] = {
    "joint_stop": {"angle": 1.1, "stiffness": 20.0, "damping": 0.05},
    "saturation": {"level": 3e3},
    "dead_zone": {"threshold": 5e3},
    "filling_flow": {"rate": 5e3, "power": 1.0},
    "nonlinear_stiffness": {"cubic": 3e3, "centre": 0.2},
    "rate_limit": {"rate": 5e3},
}
"""The same where a leg that stands and gives way under small pressures asks for others."""

SMOOTH = 5e-5
"""Largest difference between the engines [rad]."""
KINKED = {"coulomb_friction": 1e-3, "stribeck_friction": 1e-3, "hysteresis": 1e-3, "joint_stop": 2e-4}
"""The same where the law has kinks, which MuJoCo's fixed step of 1/480 s does not resolve."""

LEG = nominal_leg()
HERE = {kind: names[-1] for kind, names in LEG.places().items()} | {"link": "thigh"}
CASES = [(name, kind) for name, cls in catalogue("elastic").items() for kind in cls.sits_at]
every_case = pytest.mark.parametrize(("name", "kind"), CASES)

PID = PidSettings({"maa": PidGains(200.0, 200.0, 3.0), "baa": PidGains(60.0, 60.0, 1.0)})
RATE = 120
START = np.array([1.35, 0.8])


def commands(phase: Phase) -> Array:
    """(n, 2) steps up and down of both actuators, not at the same times [Pa]; a leg that stands soon falls."""
    n = 2 * RATE if phase == "swing" else RATE // 3
    t = np.arange(n) / n
    maa = np.select([t < 0.25, t < 0.55, t < 0.8], [12e3, 20e3, 6e3], 15e3)
    baa = np.select([t < 0.15, t < 0.4, t < 0.7], [4e3, 9e3, 2e3], 12e3)
    return np.stack([maa, baa], axis=1)


def effect_of(name: str, kind: str, phase: Phase = "swing") -> Effect:
    assert (name, kind) in STRONG, f"give STRONG numbers with which {name} at a {kind} cannot be overlooked"
    values = STRONG[name, kind]
    return make(name, HERE[kind], IN_STANCE.get(name, values) if phase == "stance" else values)


def in_mujoco(model: Model) -> Array:
    """(n, 2) what the sensors of a plant without noise say just before each command [rad]."""
    plant, given = MujocoPlant(model), commands(model.phase)
    seen = [plant.reset(Start(position=START, command=given[0])).position]
    for command in given[:-1]:
        seen.append(plant.step(command).position)
    return np.array(seen)


def reduced(model: Model, recording: Recording | None = None) -> Array:
    """(n, 2) the same by the reduced engine [rad], at a quarter of the plant's step."""
    if recording is None:
        given = commands(model.phase)
        time, still = np.arange(len(given)) / RATE, np.tile(START, (len(given), 1))
        recording = Recording("r", time, given, still, LEG.actuator_names, LEG.joint_names)
    return predict(model, recording, engine="reduced", start=START, dt=1 / 1920)


@lru_cache(maxsize=2)
def plain(phase: Phase) -> Array:
    return reduced(Model(LEG, phase=phase))


def test_the_catalogue_is_whole() -> None:
    own = {name for name, cls in catalogue("elastic").items() if cls.__module__.startswith("equimus_ctrl.")}
    assert own == CATALOGUE == {name for name, _ in STRONG}


@pytest.mark.parametrize("phase", ["swing", "stance"])
@every_case
def test_plant_and_reduced_engine_agree(name: str, kind: str, phase: Phase) -> None:
    model = Model(LEG, (effect_of(name, kind, phase),), phase)
    expected = reduced(model)
    tolerance = KINKED.get(name, SMOOTH)
    np.testing.assert_allclose(in_mujoco(model), expected, rtol=0, atol=tolerance)
    change = np.abs(expected - plain(phase)).max()
    if (phase, kind, name) == ("stance", "foot", "payload_mass"):
        assert change < 1e-12  # it stands still
    else:
        assert change > 10 * tolerance


@every_case
def test_in_closed_loop_too(name: str, kind: str) -> None:
    """What a controller's own commands did to the plant is what they do to the reduced engine."""
    model = Model(LEG, (effect_of(name, kind),))
    start = Start(position=START, command=np.array([12e3, 4e3]))
    done = run(MujocoPlant(model), PidController(PID), HoldReference([1.5, 0.3]), 1.0, start=start)
    recorded = done.recording("closed loop")
    assert np.ptp(recorded.command, axis=0).min() > 1e3
    tolerance = KINKED.get(name, SMOOTH)
    np.testing.assert_allclose(reduced(model, recorded), recorded.position, rtol=0, atol=tolerance)
    assert np.abs(reduced(Model(LEG), recorded) - recorded.position).max() > 10 * tolerance
