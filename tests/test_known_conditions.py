"""What is known to be different in one trial reaches every engine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mjcf_models import CRANE

from equimus_ctrl.effects import PayloadMass
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model, nominal_model

CASES = [
    (nominal_model(), "foot", {"maa.stiffness": 300.0}, {"baa.area": 0.8}, [1.2, 0.6], 9e3),
    (Model(CRANE), "tip", {"shoulder.damping": 0.3}, {"servo.kp": 0.9}, [0.1, 0.1], 0.3),
]


@pytest.mark.parametrize("engine", ["reduced", "mujoco"])
@pytest.mark.parametrize(("model", "place", "settings", "factors", "start", "size"), CASES, ids=["leg", "crane"])
def test_a_condition_is_the_robot_that_it_makes(
    engine: str, model: Model, place: str, settings: dict[str, float], factors: dict[str, float], start: list[float],
    size: float,
) -> None:  # fmt: skip
    command = np.full((1, len(model.robot.actuator_names)), size)
    plain = Trial("plain", np.zeros(1), command, command[0], 0.0, np.array(start), np.linspace(0.01, 0.4, 8))
    known = replace(plain, settings=settings, factors=factors, payloads={place: 0.2})
    values = model.parameters()
    changed = model.with_parameters({**settings, **{name: own * values[name] for name, own in factors.items()}})
    loaded = Model(changed.robot, (PayloadMass(place, 0.2),))
    own = engine_for(model, engine, 1e-3)  # type: ignore[arg-type]
    first, there = own.simulate([model], [plain, known], [np.array([start])] * 2)
    (same,) = own.simulate([loaded], [plain], [np.array([start])])
    np.testing.assert_allclose(there.position, same.position, atol=1e-9)
    assert np.abs(there.position - first.position).max() > 1e-3
