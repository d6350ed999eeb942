"""Concealed realities: legs with wrong numbers and perhaps something left out, from a seed and a case number."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from equimus_ctrl.effects.base import REGISTRY, Effect
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof import sizes
from equimus_ctrl.proof.designs import DURATION, TRIALS, TrialDesign, design
from equimus_ctrl.proof.outside import OUTSIDE
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import Morphology, elastic_of
from equimus_ctrl.types import Array

Kind = Literal["none", "single", "pair", "outside"]
SHARES: dict[Kind, float] = {"none": 0.3, "single": 0.35, "pair": 0.2, "outside": 0.15}
"""How often each kind is drawn where nobody asks for one."""

SPREAD = {"stiffness": 0.15, "area": 0.15, "rest_length": 0.02, "damping": 0.4}
"""± share of the nominal leg's numbers."""

ALIKE = frozenset(
    {
        *("transport_delay", "first_order_lag", "asymmetric_lag", "rate_limit", "filling_flow"),
        *("dead_zone", "cutoff", "supply_coupling"),
        *("hysteresis", "creep", "coulomb_friction", "sensor_delay", "sensor_scale", "backlash"),
    }
)
"""Effects that can act alike in several places: what is built alike ails alike."""
ALIKE_SHARE = 0.25

NOISE = (1e-3, 3e-3)
"""Standard deviation of each joint's noise [rad]."""
CORRELATION = (5e-3, 80e-3)
"""Correlation time of coloured noise [s]."""

WHAT, DESIGN, NOISE_STREAM, REST = range(4)
"""Streams of random numbers of one case, kept apart so that a change to one leaves the others' bits alone."""


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
        raise ConfigError(unknown_name("kind of reality", str(kind), get_args(Kind)))
    kinds: list[Kind] = list(SHARES)
    drawn = kinds[int(rng.choice(len(kinds), p=list(SHARES.values())))]
    return kind or drawn


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


@dataclass(frozen=True, eq=False)
class Reality:
    """One concealed reality.

    Attributes:
        case: its number.
        seed: of the whole proof.
        kind: how much is left out of the nominal model.
        robot: with its true parameters.
        effects: from the catalogue.
        outside: physics from outside it.
        noise: standard deviation of each joint's noise [rad].
        correlation: correlation time of the noise [s]; 0 where it is white.
        trials: what is measured.
        rest_bias: (trials, nj + na) where within its dry friction each place came to rest, −1 to 1.
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

    @property
    def model(self) -> Model:
        """The robot with its effects from the catalogue."""
        return Model(self.robot, self.effects)

    @property
    def leg(self) -> Morphology:
        """The robot, where it has elastic actuators."""
        return elastic_of(self.robot)


def draw(
    seed: int, case: int, *, kind: Kind | None = None, trials: int = TRIALS, duration: float = DURATION
) -> Reality:
    """The reality of a case.

    Args:
        seed: of the whole proof.
        case: its number.
        kind: by default one of ``SHARES``.
        trials: how many.
        duration: of each [s].

    Raises:
        ConfigError: for an unknown kind or a seed or case below 0.
    """
    rng = stream(seed, case, WHAT)
    kind = kind_of(rng, kind)
    leg = draw_leg(rng)
    noise, correlation = draw_noise(rng, [NOISE] * len(leg.joints), CORRELATION)
    effects: tuple[Effect, ...] = ()
    outside: tuple[Effect, ...] = ()
    if kind == "single":
        effects = _attach(rng, _any_of(rng, catalogue()), leg, REGISTRY)
    elif kind == "pair":
        effects = _draw_pair(rng, leg)
    elif kind == "outside":
        outside = _attach(rng, _any_of(rng, sorted(OUTSIDE)), leg, OUTSIDE)
    bias = stream(seed, case, REST).uniform(-0.8, 0.8, (trials, len(leg.joints) + len(leg.actuators)))
    designs = design(stream(seed, case, DESIGN), trials, duration)
    return Reality(case, seed, kind, leg, effects, outside, noise, correlation, designs, bias)


def draw_leg(rng: np.random.Generator) -> Morphology:
    """The nominal leg with its uncertain numbers spread evenly."""
    leg = nominal_leg()
    names = [f"{a.name}.{key}" for a in leg.actuators for key in SPREAD] + [f"{j.name}.damping" for j in leg.joints]
    nominal = leg.parameters()
    shares = {name: SPREAD[name.rpartition(".")[2]] * rng.uniform(-1.0, 1.0) for name in names}
    return leg.with_parameters({name: float(f"{nominal[name] * (1 + share):.8g}") for name, share in shares.items()})


def catalogue() -> list[str]:
    """Registered effects that the table of sizes knows; those of users are left alone."""
    return sorted({row.effect for row in sizes.CATALOGUE} & set(REGISTRY))


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


def _any_of(rng: np.random.Generator, names: list[str]) -> str:
    return names[int(rng.integers(len(names)))]


def _draw_pair(rng: np.random.Generator, leg: Morphology) -> tuple[Effect, ...]:
    """Two different effects that one leg can have."""
    while True:
        first, second = (_any_of(rng, catalogue()) for _ in range(2))
        if first == second:
            continue
        both = (*_attach(rng, first, leg, REGISTRY), *_attach(rng, second, leg, REGISTRY))
        try:
            Model(leg, both)
        except ConfigError:  # two that exclude each other
            continue
        return both


def _attach(rng: np.random.Generator, name: str, leg: Morphology, known: dict[str, type[Effect]]) -> tuple[Effect, ...]:
    """An effect at a random place, or alike at all places of one kind."""
    cls = known[name]
    kind = cls.sits_at[int(rng.integers(len(cls.sits_at)))]
    # The last link's tip is the foot: one place is not to have two names.
    sites = [site for site in leg.places()[kind] if kind != "link" or site != leg.foot]
    everywhere = len(sites) > 1 and name in ALIKE and rng.random() < ALIKE_SHARE
    location = sites[int(rng.integers(len(sites)))]
    values = _values(rng, cls, kind, location)
    chosen = sites if everywhere else [location]
    return tuple(cls(site, **values) for site in chosen)


def _values(rng: np.random.Generator, cls: type[Effect], kind: str, location: str) -> dict[str, float]:
    rows = [sizes.size_of(cls.name, key, kind, location) for key in cls.parameter_info()]
    while True:
        values = {row.parameter: row.draw(rng) for row in rows}
        if not sizes.by_another_name(cls.name, values):
            return values
