"""Rivals of legs and arms, from diagnoses made by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
from pendulum_runs import PENDULUM, SERVO, recorded

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.effects import CoulombFriction, ViscousFriction
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.identification.channels import with_channels
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot


def with_other(diagnosis: Diagnosis) -> Diagnosis:
    """The same where the model without any effect fits as well as what was found."""
    return replace(diagnosis, explanations=(diagnosis.base,))


@cache
def rivals_of(diagnosis: Diagnosis) -> Rivals:
    return Rivals.of(with_other(diagnosis))


def read_back(rivals: Rivals, model: Model | None = None) -> Rivals:
    """As a record has them."""
    return Rivals.from_dict(json.loads(json.dumps(rivals.to_dict())), model or rivals.model)


def steps(seed: int = 0, duration: float = 3.0) -> Commands:
    """Pressures of a leg that jump every 0.6 s."""
    rng = np.random.default_rng(seed)
    levels = rng.uniform([2e3, 0.0], [30e3, 15e3], (5, 2))
    return Commands(0.6 * np.arange(5), levels, duration)


@cache
def of_a_pendulum(also: tuple[str, ...] = ()) -> Rivals:
    """Dry or viscous friction at the hinge of a pendulum with a servo, from two trials of two seconds."""
    real = Model(MjcfRobot("arm", PENDULUM.format(drive=SERVO)))
    recordings = recorded(replace(real, effects=(CoulombFriction("hinge", friction=0.1),)), count=2, seconds=2.0)
    rates = [np.gradient(r.position, r.time, axis=0) for r in recordings]
    marked = [replace(r, velocity=v) for r, v in zip(recordings, rates, strict=True)]
    segments = tuple(cut(real, with_channels(marked, also) if also else marked, shoot=1.0))
    data = Data(free_parameters(real, ["arm.mass"]), segments, reduced_simulator(2e-3, threads=1))
    starts = [s.start for s in segments]

    def fitted(effect: type[Effect], **values: float) -> Fitted:
        part = Part(Candidate(effect, ("hinge",), (values,)), values)
        begin = (np.append(data.free.start, list(values.values())), starts)
        return data.coarse_fit((part,), [begin], white_noise([np.full((9, 1 + len(also)), 5e-4)]), 5)

    dry, viscous = fitted(CoulombFriction, friction=0.05), fitted(ViscousFriction, damping=0.05)
    whole = SimpleNamespace(
        verdict="explained", model=real, best=dry, train=segments, unexplained=(), explanations=(viscous,), nearest=(),
        below=(), interval=1.0,
    )  # fmt: skip
    return Rivals.of(whole)
