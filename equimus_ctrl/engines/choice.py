"""The engines, and which of them simulates a model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import get_args

import casadi as ca
import mujoco
import numpy as np

from equimus_ctrl.effects.base import Robots
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.engines.base import Discretisation, Engine, EngineName
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.contacts import touching
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.mjcf_realised import stepped_laws
from equimus_ctrl.engines.mjcf_tracked import Followed, simulate_tracked
from equimus_ctrl.engines.mjcf_tracking import balanced, by_acceleration, fed_forward, law_at
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS
from equimus_ctrl.engines.mujoco_trials import simulate_mujoco
from equimus_ctrl.engines.step_choice import StepChoice, followed_step, noise_of
from equimus_ctrl.engines.steps import step_divisor
from equimus_ctrl.engines.trials import Predicted, Trial
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.robots.mjcf.robot import MjcfRobot, mjcf_of
from equimus_ctrl.types import Array, FeedbackLaw

STEP = 3e-3
"""Physics step of the reduced engine in fits [s], where the robot allows it: an error of 1e-5 rad, or 3e-5 rad with
static friction, a hundredth of what sensors' noise is."""
REDUCED_COARSER, REDUCED_FINER = 2.0, 3.0
"""By what the reduced engine's step is multiplied to screen candidates, and divided to compare alternatives."""
MUJOCO_COARSER = 2.0
"""Of MuJoCo's step, where candidates are screened."""
STEPS_FINER = 4
"""So many of MuJoCo's physics steps take the place of one where its error is looked at."""
MOST_OPERATIONS, MOST_LINKS = 16_000, 40
"""Equations of motion with more take longer than two minutes to compile, at some 7 ms an operation: some sixteen hinges
in a row. Those of so many links have more in any case."""


@lru_cache(maxsize=64)
def too_large(form: Structure) -> bool:
    """Whether the accelerations of a structure take so many operations that compiling them takes minutes."""
    if form.n_links > MOST_LINKS:
        return True
    m = build(form, "swing")
    whole = ca.Function("acceleration", [m.q, m.v, m.f, m.tau, m.p], [m.acceleration])
    return bool(whole.n_instructions() > MOST_OPERATIONS)


@dataclass(frozen=True, eq=False)
class ReducedEngine(Engine):
    """The exact Lagrangian in joint coordinates, compiled, all models of a batch in the lanes of one loop.

    Attributes:
        dt: physics step [s]; by default ``longest``, divided until it follows the first model that is simulated. It
            then stays, so that a search always sees the same discretisation; see ``step_choice.StepChoice``.
        longest: [s].
        reason: see ``Engine``.
        noise: (nj,) of what is to be simulated, see ``step_choice.noise_of``; None where it is not known.
    """

    name = "reduced"
    batched = True
    costly = False
    responds_by = "linearised"

    dt: float | None = None
    longest: float = STEP
    reason: str = ""
    noise: Array | None = None
    _choice: StepChoice = field(default_factory=StepChoice, init=False, repr=False)

    @property
    def step(self) -> float | None:
        """The step that it took [s]; None where it has simulated nothing yet."""
        return self._choice.step or self.dt

    def simulate(
        self, models: Sequence[Model], trials: Sequence[Trial], starts: Sequence[Array], threads: int | None = None
    ) -> list[Predicted]:
        step = self._choice.kept(lambda: self.dt or self._short_enough(models[0], trials, [rows[0] for rows in starts]))
        asked_for = self.dt is not None
        return simulate(models, trials, starts=starts, dt=step, threads=threads, check=asked_for)

    def _short_enough(self, model: Model, trials: Sequence[Trial], starts: Sequence[Array]) -> float:
        if model.robot.traits.held_in_place:
            m = changed_bodies(model.effects, model.morphology)
            poses = [trial.position for trial in trials]
            return self.longest / step_divisor(m, model.phase, poses, self.longest, stops=False)
        return followed_step(model, trials, starts, self.longest, self.noise)

    def coarser(self) -> Engine:
        return ReducedEngine(longest=self.longest * REDUCED_COARSER, reason=self.reason, noise=self.noise)

    def finer(self) -> Engine:
        return ReducedEngine(longest=self.longest / REDUCED_FINER, reason=self.reason, noise=self.noise)


@dataclass(frozen=True, eq=False)
class ElementEngine(Engine):
    """MuJoCo with elastic actuators as 3-2-1 elements.

    Attributes:
        dt: physics step [s]; the fast settings' by default.
    """

    name = "mujoco"
    batched = True
    costly = False
    responds_by = "linearised"

    dt: float | None = None

    def simulate(
        self, models: Sequence[Model], trials: Sequence[Trial], starts: Sequence[Array], threads: int | None = None
    ) -> list[Predicted]:
        settings = replace(FAST_SETTINGS, timestep=self.dt) if self.dt else None
        return simulate_mujoco(models, trials, starts=starts, settings=settings, threads=threads)


@dataclass(frozen=True, eq=False)
class MujocoEngine(Engine):
    """MuJoCo with the XML's own integrator and solver.

    Attributes:
        robot: all that is simulated has its step and integrator.
        dt: another physics step than the XML's [s].
        reason: see ``Engine``.
        hard_friction: whether dry friction of effects holds what it stops, see ``engines.mjcf_realised.realise``.
    """

    name = "mujoco"
    batched = False
    costly = True
    responds_by = "simulated"

    robot: MjcfRobot
    dt: float | None = None
    reason: str = ""
    hard_friction: bool = True

    @property
    def discretisation(self) -> Discretisation:
        """Of the XML's step, or the one that was asked for."""
        return Discretisation(self.dt or self.robot.timestep, STEPS_FINER)

    def simulate(
        self, models: Sequence[Model], trials: Sequence[Trial], starts: Sequence[Array], threads: int | None = None
    ) -> list[Predicted]:
        return simulate_mjcf(
            models, trials, starts=starts, dt=self.dt, threads=threads, hard_friction=self.hard_friction
        )

    def tracked(
        self,
        models: Sequence[Model],
        trial: Trial,
        reference: Array,
        law: FeedbackLaw,
        starts: Array,
        noise: Array | None = None,
        threads: int | None = None,
    ) -> Followed:
        """Every model in its own closed loop, see ``mjcf_tracked.simulate_tracked``."""
        return simulate_tracked(
            models, trial, reference, law, starts=starts, noise=noise, threads=threads, dt=self.dt
        )  # fmt: skip

    def law_at(self, model: Model, pose: Array, frequency: float, period: float) -> FeedbackLaw:
        """The law by which joints track references, see ``mjcf_tracking.law_at``."""
        return law_at(model, pose, frequency, period)

    def fed_forward(self, model: Model, times: Array, reference: Array) -> Array:
        """(n, na) what is fed forward of a reference, see ``mjcf_tracking.fed_forward``."""
        return fed_forward(model, times, reference)

    def by_acceleration(self, model: Model, pose: Array) -> Array:
        """(na, nj) commands by accelerations, see ``mjcf_tracking.by_acceleration``."""
        return by_acceleration(model, pose)

    def balanced(self, model: Model, reference: Array) -> Array:
        """A reference in which joints without a drive are balanced, see ``mjcf_tracking.balanced``."""
        return balanced(model, reference)

    def coarser(self) -> Engine:
        return replace(self, dt=MUJOCO_COARSER * self.discretisation.step)

    def with_finer_step(self) -> Engine:
        return replace(self, dt=self.discretisation.step / STEPS_FINER)

    def without_step_error(self) -> Engine:
        """The error of first order goes (Richardson, 1911); Runge and Kutta's method has little at a part of it."""
        if self.robot.mujoco_model().opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
            return self.with_finer_step()
        return ExtrapolatedEngine(self, self.with_finer_step())


@dataclass(frozen=True, eq=False)
class ExtrapolatedEngine(Engine):
    """An engine without the error of first order of its step, by extrapolation from the step and a part of it.

    Attributes:
        coarse: with the step.
        fine: with a part of it.
    """

    name = "mujoco"
    batched = False
    costly = True
    responds_by = "simulated"

    coarse: Engine
    fine: Engine

    def simulate(
        self, models: Sequence[Model], trials: Sequence[Trial], starts: Sequence[Array], threads: int | None = None
    ) -> list[Predicted]:
        pairs = zip(*(e.simulate(models, trials, starts, threads) for e in (self.fine, self.coarse)), strict=True)
        with np.errstate(all="ignore"):  # numbers after a divergence mean nothing
            return [
                Predicted(
                    _extrapolated(a.position, b.position),
                    np.minimum(a.reached, b.reached),
                    None if a.motion is None or b.motion is None else _extrapolated(a.motion, b.motion),
                    None if a.forces is None or b.forces is None else _extrapolated(a.forces, b.forces),
                )
                for a, b in pairs
            ]


def _extrapolated(fine: Array, coarse: Array) -> Array:
    """Without the error of first order of a step and of a part of it (Richardson)."""
    return fine + (fine - coarse) / (STEPS_FINER - 1)


def engine_for(
    model: Model,
    name: EngineName | None = None,
    dt: float | None = None,
    positions: Sequence[Array] = (),
) -> Engine:
    """The engine that simulates a model.

    Args:
        model: whose robot decides.
        name: of the one that is asked for; by default the compiled equations of motion where they hold the robot.
        dt: physics step [s]; the engine's own choice by default.
        positions: (n, nj + np + nu) each, of what is to be simulated, see ``Recording.poses``: where bodies touch
            MuJoCo simulates.

    Raises:
        ConfigError: for a step that is none, an unknown name, or compiled equations that cannot hold the robot.
    """
    if name is not None and name not in get_args(EngineName):
        raise ConfigError(unknown_name("engine", name, get_args(EngineName)))
    if dt is not None and not 0 < dt < float("inf"):
        raise ConfigError(f"the physics step is {dt:g} s, expected more than 0")
    return ENGINES_OF[model.robot.traits.catalogue](model, name, dt, positions)


def _engine_of_elastic(
    model: Model, name: EngineName | None, dt: float | None, positions: Sequence[Array]
) -> ReducedEngine | ElementEngine:
    """Compiled equations of motion hold every robot with elastic actuators."""
    return ElementEngine(dt) if name == "mujoco" else ReducedEngine(dt)


def _engine_of_mjcf(
    model: Model, name: EngineName | None, dt: float | None, positions: Sequence[Array]
) -> ReducedEngine | MujocoEngine:
    """Compiled equations of motion where they hold all of the robot and can be compiled in time, else MuJoCo."""
    robot, own = model.robot, mjcf_of(model.robot)
    if name == "mujoco":
        return MujocoEngine(own, dt, reason="it was asked for")
    reason = next(iter(own.obstacles), None)
    if not reason and (names := touching(own, positions)):
        reason = f"contacts, and {names[0]!r} touches {names[1]!r} in the recordings"
    if reason is None and name is None and too_large(own.mechanics().form):
        joints = len(robot.joint_names)
        return MujocoEngine(own, dt, reason=f"equations of motion of {joints} joints would take minutes to compile")
    if reason is None:
        reason = "compiled equations of motion hold all of the robot"
        return ReducedEngine(dt, reason=reason, noise=noise_of([p[:, : len(robot.joint_names)] for p in positions]))
    if name == "reduced":
        raise ConfigError(f"{robot.name}: compiled equations of motion cannot hold {reason}; expected --engine mujoco")
    return MujocoEngine(own, dt, reason=f"compiled equations of motion cannot hold {reason}")


def simulation_of(model: Model, any_law: bool = True) -> MujocoEngine | None:
    """MuJoCo as it simulates the robot's XML by itself, step and solver included; None of robots that have none.

    Args:
        model: whose robot decides.
        any_law: whether its effects may have states; else None where one has, for that is compiled by itself.
    """
    usual = stepped_laws(()) == stepped_laws(model.effects)
    return SIMULATIONS_OF[model.robot.traits.catalogue](model) if any_law or usual else None


def _simulation_of_mjcf(model: Model) -> MujocoEngine:
    return MujocoEngine(mjcf_of(model.robot), reason="it made the recordings", hard_friction=False)


ENGINES_OF: dict[Robots, Callable[[Model, EngineName | None, float | None, Sequence[Array]], Engine]] = {
    "elastic": _engine_of_elastic,
    "mjcf": _engine_of_mjcf,
}
"""Kind of robots (``RobotTraits.catalogue``) → which of its engines simulates a model."""
SIMULATIONS_OF: dict[Robots, Callable[[Model], MujocoEngine | None]] = {
    "elastic": lambda model: None,
    "mjcf": _simulation_of_mjcf,
}
"""Kind of robots → what simulates their XML by itself."""
