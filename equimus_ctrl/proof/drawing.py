"""Blinded synthetic ground truth from a seed and a case number: parameters that are off, perhaps missing physics.

What all robots share stands here: the order in which things are drawn, and from which stream of random numbers. What
differs is handed in as ``Draws``, and how a robot's cases are simulated and recorded is a ``CaseSource``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from equimus_ctrl.effects.base import REGISTRY, Effect
from equimus_ctrl.errors import ConfigError, ModelError, unknown_name
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof.designs import TrialDesign
from equimus_ctrl.proof.outside import OUTSIDE
from equimus_ctrl.proof.sizes import Table, size_of
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.morphology import Morphology, elastic_of
from equimus_ctrl.types import Array, Recording

Kind = Literal["none", "single", "pair", "outside", "all_joints", "triple"]
SHARES: dict[Kind, float] = {
    "none": 0.3, "single": 0.35, "pair": 0.2, "outside": 0.15, "all_joints": 0.0, "triple": 0.0,
}  # fmt: skip
"""How often each kind is drawn where nobody asks for one."""
EFFECTS: dict[Kind, tuple[int, int]] = {
    "none": (0, 0), "single": (1, 0), "pair": (2, 0), "outside": (0, 1), "all_joints": (0, 0), "triple": (3, 0),
}  # fmt: skip
"""How many effects of each kind are in the catalogue, and how many outside it, drawn one by one."""
RUBS = ("coulomb_friction", "frictionloss"), ("viscous_friction", "damping")
"""What is missing at every joint where all of them rub, each with its own size, and which parameter of the joint would
take it up."""
PLAIN = 0.1
"""Least of these sizes, as a share of the largest: at each joint they are to be seen."""
ALIKE_SHARE = 0.25
"""How often an effect that can acts alike in several places: what is built alike ails alike."""
ATTEMPTS = 100
"""At most, to draw what a robot can have."""

WHAT, DESIGN, NOISE_STREAM, REST = range(4)
"""Streams of random numbers of one case, separate so that a change to one leaves the others' bits alone."""
STREAMS = 10
"""So many streams further begins the next attempt at a case."""


def stream(seed: int, case: int, which: int) -> np.random.Generator:
    """One of a case's generators.

    Raises:
        ConfigError: for a seed or case below 0.
    """
    if seed < 0 or case < 0:
        raise ConfigError(f"seed {seed} and case {case} are expected to be 0 or more")
    return np.random.default_rng([seed, case, which])


def kind_of(rng: np.random.Generator, kind: Kind | None) -> Kind:
    """The kind asked for, or one drawn; the generator moves on alike.

    Raises:
        ConfigError: for an unknown kind.
    """
    if kind is not None and kind not in get_args(Kind):
        raise ConfigError(unknown_name("kind of ground truth", str(kind), get_args(Kind)))
    kinds: list[Kind] = list(SHARES)
    drawn = kinds[int(rng.choice(len(kinds), p=list(SHARES.values())))]
    return kind or drawn


@dataclass(frozen=True)
class Site:
    """Where an effect is put.

    Attributes:
        location: the place that its size is drawn for.
        kind: of the place; "" where sizes are those of single places.
        everywhere: all places where it acts alike.
    """

    location: str
    kind: str
    everywhere: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Draws:
    """How ground truths of a robot differ from those of another.

    Attributes:
        nominal: the model whose parameters are perturbed.
        spread: parameter → its largest relative perturbation.
        table: sizes of effects from the catalogue and from outside it.
        choose: (generator, names, how many) → so many different names.
        place: (generator, class of an effect) → where it is put.
        noise: for each joint, between what the standard deviation of its noise is.
        correlation: between what correlation times of coloured noise are [s].
    """

    nominal: Model
    spread: Mapping[str, float]
    table: Table
    choose: Callable[[np.random.Generator, Sequence[str], int], list[str]]
    place: Callable[[np.random.Generator, type[Effect]], Site]
    noise: Sequence[tuple[float, float]]
    correlation: tuple[float, float]


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """One blinded ground truth.

    Attributes:
        case: its number.
        seed: of the whole proof.
        kind: how much is missing from the nominal model.
        robot: with its true parameters.
        effects: from the catalogue.
        outside: physics from outside it.
        noise: standard deviation of each joint's noise [rad or m].
        correlation: correlation time of the noise [s]; 0 where it is white.
        trials: what is measured.
        rest_bias: (trials, nj + na) where within its dry friction each place came to rest, −1 to 1; empty where trials
            begin at given angles.
        drawn: names of the parameters that are not the nominal robot's.
        scales: parameter of an effect → what an error of it is relative to, and where it does nothing; empty where one
            table says it of every robot.
    """

    case: int
    seed: int
    kind: Kind
    robot: Robot
    effects: tuple[Effect, ...]
    outside: tuple[Effect, ...]
    noise: tuple[float, ...]
    correlation: float
    trials: tuple[TrialDesign, ...]
    rest_bias: Array
    drawn: tuple[str, ...] = ()
    scales: Mapping[tuple[str, str], tuple[float, float | None]] = field(default_factory=dict)

    @property
    def model(self) -> Model:
        """The robot with its effects from the catalogue."""
        return Model(self.robot, self.effects)

    @property
    def leg(self) -> Morphology:
        """The robot, where it has elastic actuators."""
        return elastic_of(self.robot)


@dataclass(frozen=True)
class Excess:
    """Excess residual variance: mean squared residual of data without noise over the noise's variance, to six digits.

    Attributes:
        total: over all joints.
        joints: of each.
        parameters: fitted values by name.
    """

    total: float
    joints: tuple[float, ...]
    parameters: dict[str, float]


def draw_case(
    draws: Draws,
    trials: Sequence[TrialDesign],
    rest_bias: Array,
    seed: int,
    case: int,
    kind: Kind | None = None,
    attempt: int = 0,
) -> GroundTruth:
    """The ground truth of a case.

    Args:
        draws: how it differs from other robots'.
        trials: what is measured.
        rest_bias: see ``GroundTruth``.
        seed: as of ``CaseSource.draw``.
        case: as there.
        kind: as there.
        attempt: as there.

    Raises:
        ConfigError: see there.
    """
    rng = stream(seed, case, WHAT + STREAMS * attempt)
    kind = kind_of(rng, kind)
    real = perturbed(rng, draws)
    noise, correlation = draw_noise(rng, draws.noise, draws.correlation)
    inside, beyond = EFFECTS[kind]
    effects = missing_physics(rng, draws, real, REGISTRY, inside)
    outside = missing_physics(rng, draws, real, OUTSIDE, beyond)
    if kind == "all_joints":
        effects = friction_of_all_joints(rng, draws, real)
    return GroundTruth(
        case, seed, kind, real.robot, effects, outside, noise, correlation, tuple(trials), rest_bias,
        tuple(draws.spread),
    )  # fmt: skip


def perturbed(rng: np.random.Generator, draws: Draws) -> Model:
    """The nominal model with its uncertain parameters spread evenly."""
    nominal = draws.nominal.parameters()
    shares = {name: most * rng.uniform(-1.0, 1.0) for name, most in draws.spread.items()}
    return draws.nominal.with_parameters(
        {name: float(f"{nominal[name] * (1 + share):.8g}") for name, share in shares.items()}
    )


def draw_noise(
    rng: np.random.Generator, sizes: Sequence[tuple[float, float]], times: tuple[float, float]
) -> tuple[tuple[float, ...], float]:
    """(standard deviation of each joint's noise, its correlation time [s]); every other is white, its time 0.

    Args:
        rng: moved on.
        sizes: for each joint between what its noise is.
        times: between what correlation times are [s].
    """
    noise = tuple(round(float(rng.uniform(*size)), 7) for size in sizes)
    coloured = bool(rng.random() < 0.5)
    return noise, round(math.exp(rng.uniform(*np.log(times))), 5) if coloured else 0.0


def missing_physics(
    rng: np.random.Generator, draws: Draws, real: Model, known: Mapping[str, type[Effect]], count: int
) -> tuple[Effect, ...]:
    """So many different effects that the robot can have at once.

    Raises:
        ConfigError: where none of many draws can be.
    """
    if not count:
        return ()
    names = sorted(set(draws.table) & set(known))
    for _ in range(ATTEMPTS):
        chosen = draws.choose(rng, names, count)
        try:
            found = tuple(effect for name in chosen for effect in attached(rng, draws, known[name]))
            Model(real.robot, tuple(e for e in found if e.name in REGISTRY))
        except (ConfigError, ModelError):  # excluded by each other, or not possible on this robot
            continue
        if all(_plausible(effect, key, real.robot) for effect in found for key in effect.parameter_info()):
            return found
    raise ConfigError(f"{real.name}: none of {ATTEMPTS} draws gave effects that it can have")


def friction_of_all_joints(rng: np.random.Generator, draws: Draws, real: Model) -> tuple[Effect, ...]:
    """Dry and viscous friction at every joint that has no parameter of its own to take it up.

    Raises:
        ConfigError: for a robot of one joint, or of which a proof draws no friction at joints alone, or all of whose
            joints but one at most have dry friction already.
    """
    joints = real.robot.joint_names
    if len(joints) < 2 or real.robot.traits.forces_along_actuators:
        raise ConfigError(
            f"{real.name}: friction in all joints is drawn of robots of two joints or more whose drives act at joints "
            "alone, as MJCF robots' do"
        )
    without = [(law, [j for j in joints if f"{j}.{own}" not in draws.spread]) for law, own in RUBS]
    (_, dry), *_ = without
    if len(dry) < 2:
        raise ConfigError(
            f"{real.name}: its joints have dry friction already, which is estimated, so none of it is missing; for "
            "friction in all joints give a model without frictionloss"
        )
    found = []
    for name, places in without:
        for joint in places:
            (key,) = REGISTRY[name].parameter_info()
            size = size_of(draws.table, name, key, "", joint)
            found.append(REGISTRY[name](joint, **{key: replace(size, low=PLAIN * size.high).draw(rng)}))
    return tuple(found)


def _plausible(effect: Effect, key: str, robot: Robot) -> bool:
    low, high = effect.bounds(key, robot)
    return low <= float(getattr(effect, key)) <= high


def attached(rng: np.random.Generator, draws: Draws, cls: type[Effect]) -> tuple[Effect, ...]:
    """An effect at a random place, or alike at several, its size drawn for one of them.

    Raises:
        ConfigError: where many sizes in turn would be called by another effect's name.
    """
    site = draws.place(rng, cls)
    sizes = [size_of(draws.table, cls.name, key, site.kind, site.location) for key in cls.parameter_info()]
    for _ in range(ATTEMPTS):
        values = {size.parameter: size.draw(rng) for size in sizes}
        if not cls.reduces_to_simpler(values):
            return tuple(cls(location, **values) for location in site.everywhere)
    raise ConfigError(f"{cls.name} at {site.location}: {ATTEMPTS} sizes in turn are those of a simpler effect")


def findings(effects: tuple[Effect, ...]) -> list[tuple[str, tuple[str, ...], dict[str, float]]]:
    """(name, locations, parameters), effects that act alike in several places as one."""
    found: list[tuple[str, tuple[str, ...], dict[str, float]]] = []
    for effect in effects:
        for k, (name, locations, parameters) in enumerate(found):
            if name == effect.name and parameters == effect.parameters():
                found[k] = (name, (*locations, effect.location), parameters)
                break
        else:
            found.append((effect.name, (effect.location,), effect.parameters()))
    return found


def noise(ground_truth: GroundTruth) -> list[Array]:
    """For each trial (n, nj) the sensors' noise [rad or m]: white, or of first order over the time between samples."""
    rng = stream(ground_truth.seed, ground_truth.case, NOISE_STREAM)
    found = []
    for trial in ground_truth.trials:
        white = rng.standard_normal((len(trial.time), len(ground_truth.noise)))
        if ground_truth.correlation > 0:
            kept = np.exp(-np.diff(trial.time) / ground_truth.correlation)
            for k, share in enumerate(kept, start=1):
                white[k] = share * white[k - 1] + np.sqrt(1 - share**2) * white[k]
        found.append(white * np.array(ground_truth.noise))
    return found


def along(times: Array, steps: Array, values: Array) -> Array:
    """(n, k) at some times (n,) what is known at steps (m,), (m, k), along lines between them."""
    return np.column_stack([np.interp(times, steps, column) for column in values.T])


def recordings_of(ground_truth: GroundTruth, shown: Sequence[Array], digits: int | None = None) -> list[Recording]:
    """Recordings of all trials.

    Args:
        ground_truth: what happened.
        shown: for each trial (n, nj) what the sensors show [rad or m].
        digits: after the point, to which positions are rounded; not at all by default.
    """
    robot = ground_truth.robot
    return [
        Recording(
            trial.name, trial.time, trial.command, positions if digits is None else np.round(positions, digits),
            robot.actuator_names, robot.joint_names, before=trial.command[0] if trial.settles else None,
            notes=dict(trial.notes),
        )
        for trial, positions in zip(ground_truth.trials, shown, strict=True)
    ]  # fmt: skip
