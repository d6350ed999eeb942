"""The first trial with a robot of which nothing was recorded: everything moves, within the limits.

Its parameters may be off by ``UNSURE`` of what their bounds allow. Of some random multisines, each shrunk about rest
until it keeps the limits, the one is taken that moves all joints most, and shrunk further until none of many draws of
the parameters leaves the limits, as designs are.
"""

from __future__ import annotations

import numpy as np

from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.rivals import Rival, Rivals
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.errors import NothingFeasible
from equimus_ctrl.experiments.conditions import KnownCondition
from equimus_ctrl.experiments.families import Multisine
from equimus_ctrl.experiments.ground import Crowd, Ground
from equimus_ctrl.experiments.limits import Excess, Limits, Motions
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.identification.channels import Channels
from equimus_ctrl.identification.noise import JointNoise
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import rates_of

UNSURE = 0.03
"""Standard deviation of the parameters of a robot that was never recorded, in shares of what their bounds allow: of the
leg's stiffnesses 8 %, of its rest lengths 2 %."""
STILL = 1e-3
"""A robot that moves less rests [rad or m]."""
TRIED, LOOKED_AT = 24, 8
"""Multisines among which the first trial is chosen, and draws of the robot's parameters that are looked at then."""


def unrecorded(model: Model) -> Rivals:
    """What is taken for possible of a robot that was never recorded: the nominal model, its parameters uncertain."""
    parameters, robot = default_free_parameters(model), model.robot
    nj, na = len(robot.joint_names), len(robot.actuator_names)
    noise = (JointNoise(STILL),) * nj
    engine = engine_for(model)
    known = np.diag((parameters.scale / (UNSURE * (parameters.high - parameters.low))) ** 2)
    nominal = Rival((), parameters, parameters.start, known, 0.0, noise)
    low, high = robot.command_limits
    home = robot.home
    return Rivals(
        model=model,
        rivals=(nominal,),
        noise=noise,
        rate=rates_of(robot).control,
        n=0,
        channels=Channels(),
        zeros=(),
        linear=False,
        start=np.clip(np.zeros(nj), *robot.joint_range) if home is None else np.array(home),
        rest=np.clip(np.zeros(na), low, high),
        interval=None,
        trust=None,
        engine=engine.name,
        step=engine.step,
        unexplained=(),
        verdict="unfinished",
    )


def first_trial(
    model: Model, limits: Limits, seed: int, draws: int, track: float | None = None
) -> tuple[Commands, float, Excess]:
    """Commands that move everything, what the limits left of them, and how near they come to these.

    Args:
        model: of the robot.
        limits: that must not be left, with the duration.
        seed: of the draws.
        draws: of its parameters.
        track: natural frequency of feedback by which joints track references, see ``Ground.of`` [Hz].

    Raises:
        ConfigError: where the robot does not come to rest.
        NothingFeasible: where nothing that moves stays within the limits.
    """
    rivals = unrecorded(model)
    ground = Ground.of(rivals, limits, KnownCondition(), rivals.simulator(), track)
    first, family, rng = rivals.rivals[0], Multisine(), np.random.default_rng([seed, 0])

    def crowd(count: int, which: int) -> Crowd:
        thetas = first.draws(np.random.default_rng([seed, which]), count)
        return ground.crowd([model, *(first.model_at(theta) for theta in thetas)])

    few, best, most = crowd(LOOKED_AT, 1), None, 0.0
    for _ in range(TRIED):
        course = ground.commands(family, rng.random(family.dimension(len(ground.rest))), 1.0).course
        course = ground.rest + few.within(course)[0] * (course - ground.rest)
        (motions,) = few.part([0]).motions([ground.trial(course)])
        if (moved := _moved(motions, limits)) > most:
            best, most = course, moved
    if best is not None:
        amplitude, excess = crowd(draws, 2).within(best)
        if amplitude > 0:
            return ground.trial(ground.rest + amplitude * (best - ground.rest)), amplitude, excess
    raise NothingFeasible(
        f"{model.name}: of {TRIED} multisines none that moves it stays within the limits; expected wider limits"
    )


def _moved(motions: Motions, limits: Limits) -> float:
    """How much everything moves: of all joints the standard deviation over the range, their geometric mean."""
    span = limits.joint_high - limits.joint_low
    share = motions.position[0].std(axis=0) / np.where(np.isfinite(span), span, 1.0)
    return float(np.exp(np.log(np.maximum(share, 1e-300)).mean()))
