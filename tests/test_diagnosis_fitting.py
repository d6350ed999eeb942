"""Fits of hypotheses with parameters that derivatives do not lead to: discontinuous ones, and such as are even."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from coupled_arm import ARM_OF_HINGES, driven

from equimus_ctrl.diagnosis.fitting import PROFILE_FALL, Data, Fitted
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, default_free_parameters
from equimus_ctrl.effects.bodies import TetherWithFreeLength
from equimus_ctrl.effects.valves import Cutoff
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import reduced_simulator, simulator_for
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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("most", [10.0, 0.05], ids=["to one side", "where a bound forbids it to the other"])
def test_across_a_planar_arms_plane_a_tethers_end_is_looked_for_beside_the_plane(
    most: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Predictions are even in it, so derivatives in the plane say nothing of it, and fits that begin there stay."""
    rng, arm = np.random.default_rng(5), Model(ARM_OF_HINGES)
    there = {"stiffness": 25.0, "x": 0.35, "y": 0.3, "z": -0.3, "length": 0.3}
    tied, asked = Model(ARM_OF_HINGES, (TetherWithFreeLength("tip", **there),)), []
    for k in range(3):
        time, commands = driven(rng, 4.0)
        start = np.broadcast_to(rng.uniform(-0.4, 0.4, 2), commands.shape)
        asked.append(Recording(f"run_{k}", time, commands, start, arm.robot.actuator_names, arm.robot.joint_names))
    segments, simulator = cut(tied, asked), simulator_for(tied)
    moved = [p.position[0] for p in simulator([tied], segments, [s.start[None] for s in segments])]
    shown = [replace(r, position=q + rng.normal(0, 5e-4, q.shape)) for r, q in zip(asked, moved, strict=True)]

    free = free_parameters(arm, ["upper.mass", "fore.mass"])
    data = Data(free, cut(arm, shown), simulator_for(arm))
    in_the_plane = {**there, "y": 1e-9, "length": 0.1}
    part = Part(Candidate(TetherWithFreeLength, ("tip",), (in_the_plane,)), in_the_plane)
    still = white_noise([5e-4 * rng.normal(size=s.measured.shape) for s in data.segments])
    begun = data.coarse_fit(
        (part,), [(data.theta_of(free.start, (part,)), [s.start for s in data.segments])], still, 30
    )
    assert begun.hypothesis[0].values["y"] == pytest.approx(0.0, abs=1e-6)
    if most < 1.0:
        info = TetherWithFreeLength.parameter_info()
        bounds = {**info, "y": {**info["y"], "high": most}}
        monkeypatch.setattr(TetherWithFreeLength, "parameter_info", classmethod(lambda cls: bounds))
        begun = data.coarse_fit(begun.hypothesis, [begun.begin], still, 5)
    found = data.converge(begun)
    values = found.hypothesis[0].values
    assert begun.deviance - found.deviance > 100 and abs(values["y"]) == pytest.approx(0.3, rel=0.1)
    assert values["y"] <= most
    assert values["length"] == pytest.approx(0.3, rel=0.15) and values["stiffness"] == pytest.approx(25.0, rel=0.1)
