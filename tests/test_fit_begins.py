"""A law that begins somewhere does nothing below that, and a fit that begins there ends there."""

from __future__ import annotations

import numpy as np
import pytest

from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.screening import screen
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.proof.leg_simulation import recordings, simulate
from equimus_ctrl.proof.legs import draw


@pytest.mark.slow
def test_a_dead_zone_that_few_commands_are_in_is_found_from_its_guesses() -> None:
    """Rest lengths do the same as a dead zone below all commands but 0: its best size to first order is there."""
    model, ground_truth = nominal_model(), draw(30116102, 23)
    (true,) = ground_truth.effects
    assert (true.name, true.location) == ("dead_zone", "maa")
    trials = recordings(ground_truth, simulate(ground_truth))
    segments = cut(model, [trials[k] for k in (0, 1, 2, 4, 5, 6)], fit_start=True)
    data = Data(default_free_parameters(model), segments, reduced_simulator(threads=1))
    base, (candidate,) = data.base(), [c for c in candidates(model, segments) if c.label == "dead_zone:maa"]
    (screened,) = screen(data, base, [candidate])

    def gain(thetas: list[np.ndarray]) -> tuple[float, float]:
        begins = [(theta, base.fit.starts) for theta in thetas]
        found = data.coarse_fit(screened.hypothesis, begins, base.noise, 12)
        return base.deviance - found.deviance, found.fit.theta[-1]

    alone, _ = gain([screened.begin])
    whole, threshold = gain(screened.begins(data, base, many_minima=False))
    assert alone < 1.0 and whole > 500.0
    assert threshold == pytest.approx(true.parameters()["threshold"], rel=0.01)
