"""Fits of hypotheses with discontinuous parameters, on commands that sweep and on commands of few sizes."""

from __future__ import annotations

import numpy as np
import pytest

from equimus_ctrl.diagnosis.fitting import PROFILE_FALL, Data, Fitted
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, default_free_parameters
from equimus_ctrl.effects.valves import Cutoff
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.types import Array, Recording

LEAST, NOISE, RATE = 5.8e3, 1.5e-3, 100.0
TIME = np.arange(0, 6.0, 1 / RATE)


def recorded(commands: list[Array]) -> list[Recording]:
    """What a nominal leg does whose first valve has a cutoff."""
    leg, rng, found = Model(nominal_model().morphology, (Cutoff("maa", LEAST),)), np.random.default_rng(3), []
    for k, command in enumerate(commands):
        start = Kinematics(leg.morphology).equilibrium(np.where(command[0] < [LEAST, 0], 0, command[0]))
        clean = simulate([leg], [Trial("", TIME, command, command[0], 0.0, start, TIME)], dt=1e-3)[0].position[0]
        measured = clean + NOISE * rng.normal(size=clean.shape)
        found.append(Recording(f"trial_{k}", TIME, command, measured, ("maa", "baa"), ("hip", "knee")))
    return found


def fitted(commands: list[Array], guess: float) -> tuple[Data, Fitted]:
    trials = recorded(commands)
    free = default_free_parameters(nominal_model())
    data = Data(free, split(free.model, trials).train, reduced_simulator(threads=1))
    part = Part(Candidate(Cutoff, ("maa",), ({"least": guess},)), {"least": guess})
    begin = np.append(free.start, guess), [s.start for s in data.segments]
    still = white_noise([NOISE * np.random.default_rng(0).normal(size=s.measured.shape) for s in data.segments])
    return data, data.converge(data.coarse_fit((part,), [begin], still, 10))


def test_a_threshold_that_no_slope_leads_to_is_found_by_grid_scans() -> None:
    sweeps = [
        np.column_stack([1e4 + 9e3 * np.sin(2 * np.pi * (f + 0.05 * TIME) * TIME), np.full(len(TIME), 8e3)])
        for f in (0.4, 0.7)
    ]
    data, found = fitted(sweeps, 4.6e3)
    (place,) = data.discontinuous(found.hypothesis)
    assert found.hypothesis[0].values["least"] == found.fit.theta[place]
    low, high = data.span(found, place)
    assert low <= LEAST <= high and high - low < 0.05 * LEAST
    # Of white noise −2 ln L = Σ ln σ² + r²/σ², but for a constant.
    counts, squares = sum(len(r) for r in found.fit.residuals), sum((r**2).sum(axis=0) for r in found.fit.residuals)
    variance = np.array([joint.white**2 for joint in found.noise])
    assert all(joint.coloured == 0.0 for joint in found.noise)
    likelihood = (counts * np.log(variance) + squares / variance).sum()
    assert found.deviance == pytest.approx(likelihood, rel=1e-9)
    # The truth's own fit is hardly better.
    _, known = fitted(sweeps, LEAST)
    assert found.deviance < known.deviance + PROFILE_FALL


def test_between_two_sizes_of_commands_every_threshold_is_as_good() -> None:
    sizes = np.array([2e3, 4e3, 8e3, 14e3])
    steps = [
        np.column_stack([sizes[np.minimum((TIME / 1.5).astype(int), 3)][order], np.full(len(TIME), 8e3)])
        for order in (slice(None), slice(None, None, -1))
    ]
    data, found = fitted(steps, 5e3)
    low, high = data.span(found, *data.discontinuous(found.hypothesis))
    # An end is the first value evaluated beyond either size.
    assert 2.5e3 < low <= 4e3 and 8e3 <= high < 12e3
