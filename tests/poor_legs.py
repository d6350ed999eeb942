"""Legs with a hidden effect that two poor trials were made of, and one more that is predicted, then made."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.diagnosis.screening import Screened, screen
from equimus_ctrl.experiments.power import powers
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.experiments.separation import separations
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.proof.designs import TrialDesign, sample_times
from equimus_ctrl.proof.drawing import DESIGN, REST, GroundTruth, draw_case, stream
from equimus_ctrl.proof.leg_simulation import recordings, simulate
from equimus_ctrl.proof.legs import leg_draws
from equimus_ctrl.types import Array, Recording

SECONDS = 6.0
MIDDLE, REACH = np.array([18e3, 9e3]), np.array([9.6e3, 5.4e3])


def chirps(rng: np.random.Generator) -> tuple[TrialDesign, ...]:
    """Two small ones of both pressures."""
    found = []
    for k in range(2):
        time = sample_times(rng, SECONDS)
        top, mean = rng.uniform(0.8, 2.5), rng.uniform((12e3, 5e3), (20e3, 9e3))
        size, swept = rng.uniform(0.3, 0.5) * mean, np.maximum(time - 0.5, 0.0)
        phase = 2 * np.pi * (0.1 * swept + (top - 0.1) * swept**2 / (2 * (SECONDS - 0.5)))
        command = mean + size * np.sin(phase[:, None] * [1.0, 0.7])
        found.append(TrialDesign(f"trial_{k:02d}", "multisine", time, np.round(command)))
    return tuple(found)


def hidden(seed: int, case: int) -> GroundTruth:
    bias = stream(seed, case, REST).uniform(-0.8, 0.8, (2, 4))
    return draw_case(leg_draws(), chirps(stream(seed, case, DESIGN)), bias, seed, case, "single")


def steps(rng: np.random.Generator) -> Commands:
    levels = np.round(MIDDLE + REACH * rng.uniform(-1, 1, (6, 2)))
    return Commands(np.array([0.0, *(0.5 + 0.9 * np.arange(5))]), levels, SECONDS)


def made(truth: GroundTruth, commands: Commands, seed: int) -> Recording:
    """The trial, with noise of its own."""
    time = sample_times(np.random.default_rng(seed), SECONDS)
    rows: Array = commands.commands[np.searchsorted(commands.times, time, side="right") - 1]
    design = TrialDesign("new", "steps", time, rows)
    one = replace(truth, trials=(design,), rest_bias=truth.rest_bias[:1], seed=truth.seed + 1000)
    return recordings(one, simulate(one))[0]


def poor_trials_and_one_more(seed: int, case: int, other: str) -> tuple[float, float]:
    """The gap predicted between the true effect and the best fit of another, and what it then is."""
    model, truth, simulator = nominal_model(), hidden(seed, case), reduced_simulator(threads=1)
    segments = cut(model, recordings(truth, simulate(truth)), fit_start=True)
    data = Data(default_free_parameters(model), segments, simulator)
    base = data.base()

    def fitted(own: Screened) -> Fitted:
        begins = [(theta, base.fit.starts) for theta in own.begins(data, base, False)]
        return data.converge(data.coarse_fit(own.hypothesis, begins, base.noise, 15))

    true = {effect.location for effect in truth.effects}
    screened = screen(data, base, candidates(model, segments))
    name = truth.effects[0].name
    right = next(s for s in screened if s.candidate.effect.name == name and set(s.candidate.locations) == true)
    first = fitted(right)
    second = min((fitted(s) for s in screened if s.candidate.effect.name == other), key=lambda f: f.deviance)
    rivals = Rivals.of(
        SimpleNamespace(
            verdict="explained", model=model, best=first, train=tuple(segments), unexplained=(), nearest=(), below=(),
            explanations=(second,), interval=None,
        )
    )  # fmt: skip
    designs = [steps(np.random.default_rng([seed, case, k])) for k in range(12)]
    found = [apart.distance(0, 1) for apart in separations(rivals, designs, simulator=simulator)]
    commands = designs[int(np.argmax(found))]
    (power,) = powers(rivals, commands, np.random.default_rng(0), pairs=[(0, 1)], draws=8, simulator=simulator)
    (new,) = cut(model, [made(truth, commands, case)], fit_start=True)
    whole = replace(data, segments=[*segments, replace(new, recording=2)])

    def again(own: Fitted) -> Fitted:
        begin = (own.fit.theta, [*own.fit.starts, new.start])
        return whole.converge(whole.coarse_fit(own.hypothesis, [begin], own.noise, 20))

    realised = again(second).deviance - again(first).deviance - (second.deviance - first.deviance)
    return power.gap, realised
