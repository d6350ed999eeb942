"""What a tuning study is: where to search, what to reach, on which legs, within which limits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from typing import Any, get_args, get_type_hints

from equimus_ctrl.controllers.pid_settings import PidGains, PidSettings, Space
from equimus_ctrl.controllers.search_space import Narrowing, Range
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.types import Array

FORMAT, ON_PLANT = "equimus-ctrl/tuning/1", "equimus-ctrl/plant-tuning/1"
"""Of studies of a PID's gains on the compiled loop of robots with elastic actuators, and of what any controller
declares on the plant of any robot (``tuning.plant_tuning``)."""
SHORTEST, LONGEST = 0.1, 3600.0
"""An objective runs at least and at most this long [s]: there is nothing to judge in less, and each candidate is driven
for as long on each robot of the ensemble."""

MOST_CANDIDATES, MOST_ROBOTS = 1_000_000, 10_000
"""All of a study's are kept in memory."""


def _check(owner: str, key: str, value: float, low: float, high: float = math.inf) -> None:
    if not (low <= value <= high and value < math.inf):
        bound = f"at least {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"
        shown = value if isinstance(value, int) else f"{value:g}"
        raise ConfigError(f"{owner}: {key} is {shown}, expected {bound}")


@dataclass(frozen=True)
class Objective:
    """One scenario the gains must do well in.

    Attributes:
        scenario: name or path of a scenario script.
        weight: how much it counts.
        duration: how long it is run [s]; the scenario's own duration by default.
    """

    scenario: str
    weight: float = 1.0
    duration: float | None = None

    def __post_init__(self) -> None:
        _check(f"objective {self.scenario}", "weight", self.weight, 0.0)
        if self.duration is not None:
            _check(f"objective {self.scenario}", "duration", self.duration, SHORTEST, LONGEST)


@dataclass(frozen=True)
class Weights:
    """cost = Σ weight × term in each run, then (1 − worst)·mean + worst·max over the ensemble.

    Attributes:
        error: of the root mean square tracking error [1/rad].
        overshoot: of the largest overshoot as a share of the step.
        settling: of the time until within ``settled`` for good [1/s].
        offset: of the root mean square error in the last quarter of a step [1/rad].
        effort: of the root mean square pressure as a share of the range.
        chatter: of the pressure travelled per second as a share of the range [s].
        give: of how far the linearised loops give way to a load of a tenth of the command range that sets in and stays
            [1/(rad √s)]; of the PID on the compiled loop.
        worst: share of the worst member in the cost.
        settled: a joint has settled when it stays so near to its reference [rad].
    """

    error: float = 10.0
    overshoot: float = 0.5
    settling: float = 0.3
    offset: float = 20.0
    effort: float = 0.2
    chatter: float = 0.05
    give: float = 30.0
    worst: float = 0.5
    settled: float = 0.0087

    def __post_init__(self) -> None:
        for key, value in asdict(self).items():
            _check("weights", key, value, 0.0, 1.0 if key == "worst" else math.inf)


@dataclass(frozen=True)
class Limits:
    """What no member of the ensemble may exceed.

    Attributes:
        overshoot: share of the step.
        saturation: share of the time at a pressure limit.
        modulus: of the largest eigenvalue of the linearised sampled loop, below 1.
        gain_margin: factor by which all gains together may rise before a linearised loop is unstable, 1 or more.
        delay_margin: further dead time with which the robot that is latest must still come to rest, of controllers that
            have no linearised loop [s].
    """

    overshoot: float = 0.25
    saturation: float = 0.5
    modulus: float = 0.998
    gain_margin: float = 1.6
    delay_margin: float = 0.0

    def __post_init__(self) -> None:
        _check("limits", "overshoot", self.overshoot, 0.0)
        _check("limits", "saturation", self.saturation, 0.0, 1.0)
        _check("limits", "modulus", self.modulus, 0.0, 1.0)
        _check("limits", "gain_margin", self.gain_margin, 1.0, 100.0)
        _check("limits", "delay_margin", self.delay_margin, 0.0, 2.0)


@dataclass(frozen=True)
class EnsembleSettings:
    """The legs the gains must work on.

    Attributes:
        members: how many; the first is the model itself with valves at the centre of their ranges, the second the leg
            that is hardest to stabilise: longest delays, most force, least stiffness, damping and mass.
        stiffness: ± share of each actuator's stiffness.
        area: ± share of each actuator's area.
        damping: ± share of each actuator's and joint's damping.
        rest_length: ± share of each actuator's rest length.
        mass: ± share of each link's mass and inertia.
        delay: (least, most) transport delay where the model has no valve effects of its own [s].
        lag: (least, most) time constant, likewise [s].
        valve_spread: ± share of the model's own valve effects.
        noise: standard deviation of the measured angles [rad].
        unseen: further legs, never tuned on, that the result is tried on.
        corners_count: whether what the robots cost that are hardest to keep stable, corners of these ranges, counts as
            any other's; else they only have to keep limits, see ``PlantProblem.kept_on_hardest``. On a plant.
    """

    members: int = 7
    stiffness: float = 0.15
    area: float = 0.15
    damping: float = 0.40
    rest_length: float = 0.02
    mass: float = 0.10
    delay: tuple[float, float] = (0.0, 0.1)
    lag: tuple[float, float] = (0.02, 0.12)
    valve_spread: float = 0.2
    noise: float = 0.001
    unseen: int = 40
    corners_count: bool = True

    def __post_init__(self) -> None:
        _check("ensemble", "members", self.members, 1, MOST_ROBOTS)
        _check("ensemble", "unseen", self.unseen, 0, MOST_ROBOTS)
        for key in ("stiffness", "area", "damping", "rest_length", "mass", "valve_spread"):
            _check("ensemble", key, getattr(self, key), 0.0, 0.95)
        _check("ensemble", "noise", self.noise, 0.0, 0.1)
        for key in ("delay", "lag"):
            low, high = getattr(self, key)
            _check("ensemble", key, low, 0.0, 2.0)
            _check("ensemble", key, high, low, 2.0)


GAINS = ("kp", "ki", "kd")
TRACKING = 0.7
"""Tracking time of an integral in integral times T_i. Where a limit keeps the robot off by e, back-calculation settles
at the share −(1 − T_t/T_i) k_p e: at √(T_i T_d) the integral has taken all that the proportional part asks for beyond
the limit, and lacks it on the way back; at T_i it takes none, and gathers on the way back. About 0.7 the two cancel."""


@dataclass(frozen=True, kw_only=True)
class AnyStudy:
    """What studies have in common.

    Attributes:
        objectives: scenarios a controller must do well in.
        seed: of the search, the ensemble and the noise.
        candidates: sets of numbers tried in all.
        polish: share of them spent on the local search.
        weights: of the cost's terms.
        limits: hard ones.
        ensemble: the robots.
    """

    objectives: tuple[Objective, ...]
    seed: int = 1
    candidates: int = 320
    polish: float = 0.25
    weights: Weights = field(default_factory=Weights)
    limits: Limits = field(default_factory=Limits)
    ensemble: EnsembleSettings = field(default_factory=EnsembleSettings)

    def __post_init__(self) -> None:
        if not self.objectives:
            raise ConfigError("a study needs at least one [[objectives]] table")
        if not sum(o.weight for o in self.objectives) > 0:
            raise ConfigError("a study needs an objective with a weight above 0")
        _check("study", "candidates", self.candidates, 1, MOST_CANDIDATES)
        _check("study", "polish", self.polish, 0.0, 0.9)
        _check("study", "seed", self.seed, 0)


@dataclass(frozen=True, kw_only=True)
class PlantStudy(AnyStudy):
    """A study of any controller on the plant of any robot.

    Attributes:
        search: narrower ranges of what the controller declares.
        settings: of the controller beside those, as its settings file has them; what stands here is not searched.
    """

    search: Mapping[str, Narrowing] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Study(AnyStudy):
    """A study of a PID's gains on the compiled loop.

    Attributes:
        search: kp, ki, kd (each for every channel) and derivative_time → range; ``maa.kp`` is one channel's own.
        space: of the PID.
        inverse: of the PID: whether it is given the inverse of the model, effects included.
    """

    search: Mapping[str, Range]
    space: Space = "length"
    inverse: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "search", dict(self.search))
        super().__post_init__()
        for key in (*GAINS, "derivative_time"):
            if key not in self.search:
                raise ConfigError(f"search: [search.{key}] is missing")
        for key in self.search:
            if key.rpartition(".")[2] not in GAINS and key != "derivative_time":
                raise ConfigError(unknown_name("gain", key, (*GAINS, "derivative_time"), "search"))
        if self.space not in get_args(Space):
            raise ConfigError(unknown_name("PID space", str(self.space), get_args(Space), "study"))

    def ranges(self, channels: tuple[str, ...]) -> list[tuple[str, Range]]:
        """(label, range) of every searched number, in the order of a candidate's vector."""
        for name in self.search:
            if "." in name and (channel := name.rpartition(".")[0]) not in channels:
                raise ConfigError(unknown_name(f"{self.space} channel", channel, channels, "search"))
        gains = [
            (own := f"{channel}.{key}", self.search.get(own, self.search[key])) for channel in channels for key in GAINS
        ]
        return [*gains, ("derivative_time", self.search["derivative_time"])]

    def settings(self, values: Array, channels: tuple[str, ...]) -> PidSettings:
        """PID settings of a candidate's vector (see ``ranges``), to six digits.

        What is judged is what is written, and processors that round otherwise find the same. The tracking time of each
        channel is ``TRACKING`` T_i = ``TRACKING`` k_p/k_i, no less than Åström & Hägglund's √(T_i T_d) = √(k_d/k_i).
        """
        rounded = [float(f"{v:.6g}") for v in values]
        gains = {}
        for i, channel in enumerate(channels):
            kp, ki, kd = rounded[3 * i : 3 * i + 3]
            gains[channel] = PidGains(kp, ki, kd, float(f"{max(math.sqrt(kd / ki), TRACKING * kp / ki):.6g}"))
        return PidSettings(gains, self.space, derivative_time=rounded[-1], inverse=self.inverse)


def suits(data: Mapping[str, Any], joints: tuple[str, ...], where: str = "study") -> bool:
    """Whether a study is for a robot with these joints: one that names none is for any.

    Raises:
        ConfigError: where ``joints`` is no list of names.
    """
    named = data.get("joints")
    if named is None:
        return True
    if not isinstance(named, list) or not all(isinstance(name, str) for name in named):
        raise ConfigError(f"{where}: joints is {named!r}, expected a list of names of joints")
    return tuple(named) == joints


def study_from_dict(data: Mapping[str, Any], where: str = "study") -> Study | PlantStudy:
    """A study from what its TOML file holds.

    Raises:
        ConfigError: for an unknown or missing key or a value that cannot be, in a sentence that names the file.
    """
    table = dict(data)
    form = table.pop("format", FORMAT)
    if form not in (FORMAT, ON_PLANT):
        raise ConfigError(f"{where}: format is {form!r}, expected {FORMAT!r} or {ON_PLANT!r}")
    on_plant = form == ON_PLANT
    suits(data, (), where)
    table.pop("joints", None)
    parts: dict[str, Any] = {"weights": Weights, "limits": Limits, "ensemble": EnsembleSettings}
    try:
        if on_plant and isinstance(table.get("ensemble"), Mapping):
            table["ensemble"] = {"lag": [0.0, 0.0], **table["ensemble"]}  # valves alone are slow unless told
        for key, cls in parts.items():
            if key in table:
                table[key] = _from_table(cls, table[key], key)
        objectives = table.get("objectives", [])
        if not isinstance(objectives, list):
            raise ConfigError("objectives: expected [[objectives]] tables")
        table["objectives"] = tuple(_from_table(Objective, item, "objectives") for item in objectives)
        search, own = table.get("search", {}), "setting" if on_plant else "gain"
        if not isinstance(search, Mapping):
            raise ConfigError(f"search: expected [search.<{own}>] tables")
        kind = Narrowing if on_plant else Range
        table["search"] = {key: _range(kind, key, item) for key, item in _named(search).items()}
        if not isinstance(table.get("settings", {}), Mapping):
            raise ConfigError(f"settings is {table['settings']!r}, expected a table")
        study: Study | PlantStudy = _from_table(PlantStudy if on_plant else Study, table, "study")
        return study
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def _named(search: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Dotted name → range, of tables within tables."""
    found: dict[str, Any] = {}
    for key, value in search.items():
        deeper = isinstance(value, Mapping) and value and all(isinstance(item, Mapping) for item in value.values())
        found |= _named(value, f"{before}{key}.") if deeper else {before + key: value}
    return found


def _range(kind: type[Range | Narrowing], key: str, table: Any) -> Any:
    try:
        return _from_table(kind, table, f"search.{key}")
    except ConfigError as error:
        raise ConfigError(str(error) if str(error).startswith("search.") else f"search.{key}: {error}") from None


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _from_table(cls: Any, table: Any, where: str) -> Any:
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where} is {table!r}, expected a table")
    hints = get_type_hints(cls)
    known = {f.name: f for f in fields(cls)}
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in known:
            raise ConfigError(unknown_name("key", key, known, where))
        hint = hints[key]
        if hint == float | None:
            hint = float
        if hint in (float, int):
            kinds = (int, float) if hint is float else int
            if isinstance(value, bool) or not isinstance(value, kinds):
                raise ConfigError(f"{where}: {key} is {value!r}, expected a {'whole ' if hint is int else ''}number")
            value = hint(value)
        elif hint == tuple[float, float]:
            if not (isinstance(value, list) and len(value) == 2 and all(_is_number(v) for v in value)):
                raise ConfigError(f"{where}: {key} is {value!r}, expected two numbers")
            value = (float(value[0]), float(value[1]))
        elif hint in (str, bool) and not isinstance(value, hint):
            raise ConfigError(f"{where}: {key} is {value!r}, expected {'a text' if hint is str else 'true or false'}")
        values[key] = value
    for name, f in known.items():
        if name not in values and f.default is MISSING and f.default_factory is MISSING:
            raise ConfigError(f"{where}: {name!r} is missing")
    return cls(**values)
