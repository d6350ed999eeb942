"""Rivals of legs and arms, from diagnoses made by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
from pendulum_runs import PENDULUM, SERVO, recorded

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, default_free_parameters, parameters_of
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.rivals import Rival, Rivals, named_effects
from equimus_ctrl.effects import CoulombFriction, SensorDelay, TransportDelay, ViscousFriction
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.identification.channels import Channels, with_channels
from equimus_ctrl.identification.noise import JointNoise, white_noise
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import Model, nominal_model
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


def part_of(effect: type[Effect], locations: tuple[str, ...], **values: float) -> Part:
    return Part(Candidate(effect, locations, (values,)), values)


def by_hand(
    model: Model, *hypotheses: tuple[Part, ...], known: float = 0.1, names: tuple[str, ...] | None = None,
    start: tuple[float, ...] = (), rest: tuple[float, ...] = (0.0,), sigma: float = 1e-3,
) -> Rivals:  # fmt: skip
    """Explanations whose numbers are all known to a share of their scale, as good as each other."""
    nj = len(model.robot.joint_names)
    noise = tuple(JointNoise(sigma) for _ in range(nj))
    found = []
    for own in hypotheses:
        free = parameters_of(default_free_parameters(model, names), own)
        information = np.eye(len(free.free)) / known**2
        found.append(Rival(named_effects([p.candidate for p in own]), free, free.start, information, 0.0, noise))
    elastic = model.robot.traits.starts_at_rest
    return Rivals(
        model, tuple(found), noise, 50.0, 600, Channels(), (), False, np.array(start or [0.0] * nj), np.array(rest),
        None if elastic else 1.0, None if elastic else np.repeat([1.0, 0.05], nj), "reduced", 4e-3, (), "explained",
    )  # fmt: skip


@cache
def delays() -> Rivals:
    """A leg whose sensors are late, or its valves: nothing that is commanded tells one from the other."""
    return by_hand(
        nominal_model(),
        (part_of(SensorDelay, ("hip", "knee"), delay=0.04),),
        (part_of(TransportDelay, ("maa", "baa"), delay=0.04),),
        names=("maa.stiffness",),
        rest=(12e3, 6e3),
    )


@cache
def frictions() -> Rivals:
    """A pendulum with a servo and dry friction or viscous friction."""
    return by_hand(
        Model(MjcfRobot("arm", PENDULUM.format(drive=SERVO).replace('axis="0 -1 0"', 'axis="0 -1 0" range="-80 80"'))),
        (part_of(CoulombFriction, ("hinge",), friction=0.15),),
        (part_of(ViscousFriction, ("hinge",), damping=0.15),),
        names=("arm.mass",),
    )
