"""Intervals of bent fits: their ends lie where the misfit has risen as it should, unlike those of straight ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from equimus_ctrl.diagnosis.curved_intervals import curved_ends
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, default_free_parameters
from equimus_ctrl.effects.force import ParallelSpring
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.fit import FitSettings, fit
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.types import Recording

TIME, NOISE = np.arange(0, 4.0, 0.01), 3e-3
REST = 0.6


def fitted(stiffness: float) -> tuple[Data, Fitted]:
    """A leg with a spring about its hip, whose stiffness is in N·m/rad."""
    leg, rng = Model(nominal_model().morphology, (ParallelSpring("hip", stiffness, REST),)), np.random.default_rng(11)
    recordings = []
    for k, f in enumerate((0.4, 0.7)):
        command = np.column_stack([2e4 + 1.5e4 * np.sin(2 * np.pi * (f + 0.05 * TIME) * TIME), np.full(len(TIME), 1e4)])
        start = Kinematics(leg.morphology).equilibrium(command[0])
        clean = simulate([leg], [Trial("", TIME, command, command[0], 0.0, start, TIME)], dt=1e-3)[0].position[0]
        measured = clean + NOISE * rng.normal(size=clean.shape)
        recordings.append(Recording(f"trial_{k}", TIME, command, measured, ("maa", "baa"), ("hip", "knee")))
    free = default_free_parameters(nominal_model())
    free = replace(free, free=tuple(own for own in free.free if own.name in ("baa.stiffness", "hip.damping")))
    data = Data(free, split(free.model, recordings).train, reduced_simulator(threads=1))
    part = Part(Candidate(ParallelSpring, ("hip",), ()), {"stiffness": stiffness, "rest": REST})
    begin = np.append(free.start, [stiffness, REST]), [s.start for s in data.segments]
    still = white_noise([NOISE * rng.normal(size=s.measured.shape) for s in data.segments])
    return data, data.converge(data.coarse_fit((part,), [begin], still, 20))


def rise(data: Data, found: Fitted, place: int, value: float) -> float:
    """Of the misfit where one parameter has this value and all others are as good as can be."""
    costs = []
    for at in (float(found.fit.theta[place]), value):
        held = found.fit.parameters.held(place, at)
        begin = (np.clip(np.delete(found.fit.theta, place), held.low, held.high), found.fit.starts)
        settings = FitSettings(1e-7, 60)
        costs.append(
            fit(held, data.segments, simulator=data.simulator, settings=settings, noise=found.noise, begin=[begin]).cost
        )
    return costs[1] - costs[0]


def test_the_misfit_has_risen_by_as_much_at_both_ends_of_a_bent_fits_interval() -> None:
    data, found = fitted(stiffness=0.008)
    rest = len(found.fit.theta) - 1
    ends = curved_ends(data, found, [rest - 1, rest])
    theta, half = float(found.fit.theta[rest]), float(found.fit.uncertainty.half_width[rest])
    low, high = (rise(data, found, rest, theta + side * half) for side in (-1, 1))
    assert low < 2.0 and high > 10.0  # of χ²(1) 95 % are below 3.84
    assert all(3.2 < rise(data, found, rest, ends[rest, side]) < 4.4 for side in (-1, 1))
    assert ends[rest, -1] < REST < ends[rest, 1]


def test_a_fit_whose_parameters_are_well_known_is_straight() -> None:
    data, found = fitted(stiffness=0.4)
    rest = len(found.fit.theta) - 1
    assert curved_ends(data, found, [rest - 1, rest]) == {}
