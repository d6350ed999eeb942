"""Blinded synthetic ground truth of an MJCF robot: parameters that are off, perhaps missing physics, driven as it was.

An MJCF robot has no workspace that a proof could know of. So what is done with it is what was done with it: commands,
times and first angles are those of recordings that somebody has, and the proof is one of these experiments too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from equimus_ctrl.diagnosis.candidates import seen_places, uncertain
from equimus_ctrl.diagnosis.split import split
from equimus_ctrl.effects.base import REGISTRY, Effect
from equimus_ctrl.errors import ConfigError, ModelError
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof.designs import TrialDesign
from equimus_ctrl.proof.mjcf_sizes import mjcf_sizes
from equimus_ctrl.proof.outside import OUTSIDE
from equimus_ctrl.proof.realities import (
    ALIKE_SHARE,
    WHAT,
    Kind,
    Reality,
    draw_noise,
    kind_of,
    stream,
)
from equimus_ctrl.proof.sizes import Size, by_another_name, measured_by
from equimus_ctrl.robots.mjcf.robot import MjcfRobot, mjcf_of
from equimus_ctrl.types import Array, Recording

LITTLE_KNOWN = {"damping": 0.4, "quadratic_damping": 0.4, "frictionloss": 0.4, "armature": 0.4}
SPREAD = 0.15
"""± share of a robot's free parameters."""
NOISE = (5e-4, 2e-3)
"""Standard deviation of each joint's noise, in units of what it covers."""
CORRELATION = (0.5, 8.0)
"""Correlation time of coloured noise in sampling intervals."""
ATTEMPTS, STREAMS = 100, 10
"""At most, to draw what a robot can have."""


@dataclass(frozen=True, eq=False)
class MjcfTruth(Reality):
    """One blinded ground truth of an MJCF robot.

    Attributes:
        starts: for each trial (nj,) angles at its start [rad or m].
        notes: of each trial.
        drawn: names of the parameters that are not the nominal robot's.
        scales: parameter of an effect at a place → what an error of it is relative to, and where it does nothing.
    """

    starts: tuple[Array, ...] = ()
    notes: tuple[dict[str, str], ...] = ()
    drawn: tuple[str, ...] = ()
    scales: dict[tuple[str, str], tuple[float, float | None]] = field(default_factory=dict)

    @property
    def mjcf_robot(self) -> MjcfRobot:
        """With its true parameters."""
        return mjcf_of(self.robot)


@dataclass(frozen=True, eq=False)
class Experiment:
    """An MJCF robot and what is done with it.

    Attributes:
        model: the nominal robot.
        recordings: whose commands, times, first angles and notes are used; what else was measured only gives scales.
    """

    model: Model
    recordings: tuple[Recording, ...]

    def __post_init__(self) -> None:
        require_bare_mjcf(self.model)
        split(self.model, self.recordings)  # what cannot be diagnosed makes no proof

    @property
    def segments(self) -> tuple[Segment, ...]:
        """As a diagnosis of these recordings would cut them."""
        parts = split(self.model, self.recordings)
        return (*parts.train, *parts.heldout)


def require_bare_mjcf(model: Model) -> None:
    """Raise ConfigError where a model is of no MJCF robot, or has effects already."""
    if not isinstance(model.robot, MjcfRobot):
        raise ConfigError(f"{model.name} is no MJCF robot; a leg's experiments are drawn")
    if model.effects:
        raise ConfigError(f"{model.name} has effects already; prove with the robot alone")


def draw_mjcf(experiment: Experiment, seed: int, case: int, kind: Kind | None = None, attempt: int = 0) -> MjcfTruth:
    """The ground truth of a case.

    Args:
        experiment: what is done with which robot.
        seed: of the whole proof.
        case: its number.
        kind: by default one of ``realities.SHARES``.
        attempt: how many truths of this case were none.

    Raises:
        ConfigError: for an unknown kind, or where none of many draws can be.
    """
    rng = stream(seed, case, WHAT + STREAMS * attempt)
    chosen = kind_of(rng, kind)
    model = experiment.model
    segments = experiment.segments
    seen = seen_places(model, segments)
    table = mjcf_sizes(model, seen)
    real, drawn = _other_numbers(rng, model)
    spans = [seen[joint].span for joint in model.robot.joint_names]
    interval = seen[model.robot.joint_names[0]].interval
    noise, correlation = draw_noise(
        rng, [(NOISE[0] * s, NOISE[1] * s) for s in spans], (CORRELATION[0] * interval, CORRELATION[1] * interval)
    )
    effects: tuple[Effect, ...] = ()
    outside: tuple[Effect, ...] = ()
    if chosen == "single":
        effects = _attached(rng, real, table, REGISTRY, 1)
    elif chosen == "pair":
        effects = _attached(rng, real, table, REGISTRY, 2)
    elif chosen == "outside":
        outside = _attached(rng, real, table, OUTSIDE, 1)
    designs = [TrialDesign(r.name, "as recorded", r.time, r.command) for r in experiment.recordings]
    scales = {}
    for effect in (*effects, *outside):
        for row in table:
            if row.effect == effect.name and row.at in ("", effect.location):
                scales[effect.name, row.parameter] = measured_by(
                    row, type(effect), float(getattr(effect, row.parameter))
                )
    return MjcfTruth(
        case, seed, chosen, real.robot, effects, outside, noise, correlation, tuple(designs),
        np.zeros((len(designs), 0)),
        starts=tuple(np.array(r.position[0]) for r in experiment.recordings),
        notes=tuple(dict(r.notes) for r in experiment.recordings), drawn=drawn, scales=scales,
    )  # fmt: skip


def _other_numbers(rng: np.random.Generator, model: Model) -> tuple[Model, tuple[str, ...]]:
    """The robot with its default free parameters spread evenly."""
    names = uncertain(model).names
    nominal = model.parameters()
    for _ in range(ATTEMPTS):
        shares = {n: LITTLE_KNOWN.get(n.rpartition(".")[2], SPREAD) * rng.uniform(-1.0, 1.0) for n in names}
        try:
            real = model.with_parameters({n: float(f"{nominal[n] * (1 + s):.8g}") for n, s in shares.items()})
            mjcf_of(real.robot).mujoco_model()
        except ModelError:  # inertias that no body can have
            continue
        return real, tuple(names)
    raise ConfigError(f"{model.name}: no parameters near its own make a robot")


def _attached(
    rng: np.random.Generator, real: Model, table: Sequence[Size], known: dict[str, type[Effect]], count: int
) -> tuple[Effect, ...]:
    """So many different effects that the robot can have at once."""
    names = sorted({row.effect for row in table} & set(known))
    for _ in range(ATTEMPTS):
        chosen = [names[k] for k in rng.choice(len(names), count, replace=False)]
        try:
            found = tuple(effect for name in chosen for effect in _one(rng, real, table, known[name]))
            Model(real.robot, tuple(e for e in found if e.name in REGISTRY))
        except (ConfigError, ModelError):  # excluded by each other, or not possible on this robot
            continue
        if all(_believable(effect, key, real) for effect in found for key in effect.parameter_info()):
            return found
    raise ConfigError(f"{real.name}: none of {ATTEMPTS} draws gave effects that it can have")


def _believable(effect: Effect, key: str, real: Model) -> bool:
    low, high = effect.bounds(key, real.robot)
    return low <= float(getattr(effect, key)) <= high


def _one(rng: np.random.Generator, real: Model, table: Sequence[Size], cls: type[Effect]) -> tuple[Effect, ...]:
    sites = sorted({row.at for row in table if row.effect == cls.name})
    if sites == [""]:
        sites = [s for kind in cls.sits_at for s in real.robot.places()[kind]]
    site = sites[int(rng.integers(len(sites)))]
    everywhere = len(sites) > 1 and cls.alike and "link" not in cls.sits_at and rng.random() < ALIKE_SHARE
    rows = [row for row in table if row.effect == cls.name and row.at in ("", site)]
    for _ in range(ATTEMPTS):
        values = {row.parameter: row.draw(rng) for row in rows}
        if not by_another_name(cls.name, values):
            break
    return tuple(cls(s, **values) for s in (sites if everywhere else [site]))


def mjcf_recordings(truth: MjcfTruth, clean: Sequence[Array], disturbed: Sequence[Array]) -> list[Recording]:
    """What a diagnosis may see, to a thousandth of the noise.

    Args:
        truth: what happened.
        clean: for each trial (n, nj) what sensors without noise would show [rad or m].
        disturbed: the noise.
    """
    robot = truth.robot
    digits = int(3 - np.floor(np.log10(min(truth.noise))))
    return [
        Recording(
            trial.name, trial.time, trial.command, np.round(shown + more, digits), robot.actuator_names,
            robot.joint_names, notes=notes,
        )
        for trial, shown, more, notes in zip(truth.trials, clean, disturbed, truth.notes, strict=True)
    ]  # fmt: skip
