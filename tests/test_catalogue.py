"""Every effect of the catalogue, at every kind of place: the reduced engine and a plant in MuJoCo tell the same."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from effect_cases import CASES as NUMBERS

from equimus_ctrl.controllers.pid_settings import PidGains, PidSettings
from equimus_ctrl.effects import REGISTRY, Effect, catalogue, make
from equimus_ctrl.engines.predict import predict
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import Phase
from equimus_ctrl.types import Array, Recording, Start

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
    case = NUMBERS[name]
    assert kind in case.strong, f"give effect_cases numbers with which {name} at a {kind} cannot be overlooked"
    return make(name, HERE[kind], (phase == "stance" and case.stance) or case.strong[kind])


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
    """Every effect of the package has its numbers, and nothing else has."""
    own = {name: cls for name, cls in REGISTRY.items() if cls.__module__.startswith("equimus_ctrl.")}
    assert set(own) == set(NUMBERS)
    for name, cls in own.items():
        case, legs = NUMBERS[name], "elastic" in cls.robots
        assert set(case.strong) == (set(cls.sits_at) if legs else set()), name
        assert (case.acting is not None) == (case.plausible is not None) == bool(case.said) == legs, name
        assert (case.mjcf is not None) == ("mjcf" in cls.robots), name


@pytest.mark.parametrize("phase", ["swing", "stance"])
@every_case
def test_plant_and_reduced_engine_agree(name: str, kind: str, phase: Phase) -> None:
    model = Model(LEG, (effect_of(name, kind, phase),), phase)
    expected = reduced(model)
    tolerance = NUMBERS[name].apart
    np.testing.assert_allclose(in_mujoco(model), expected, rtol=0, atol=tolerance)
    change = np.abs(expected - plain(phase)).max()
    if (phase, kind, name) == ("stance", "foot", "payload_mass"):
        assert change < 1e-12  # it stands still
    else:
        assert change > 10 * tolerance
