"""Options of the verbs, one class each: the command line offers its fields as options, the library takes it whole.

A default, its bounds and the line of help stand here and nowhere else.
"""
# ruff: noqa: RUF009 – options are fields, made as ``dataclasses.field`` makes them

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from equimus_ctrl.errors import ConfigError, unknown_name

if TYPE_CHECKING:
    from equimus_ctrl.engines.base import EngineName
    from equimus_ctrl.identification.fit import FitSettings
    from equimus_ctrl.recordings import StaticPoses
    from equimus_ctrl.scenarios.comparison import Condition
    from equimus_ctrl.types import Controller, Recording

    Some = Path | str | Iterable[Path | str] | Sequence[Recording]
    Window = tuple[float, float]
    Bounds = Mapping[str, tuple[float, float]]

T = TypeVar("T")
GROUPINGS = ("folder",)
"""By what trials may be grouped."""


@dataclass(frozen=True)
class OnCommandLine:
    """How the command line offers a field.

    Attributes:
        takes: type of what is given there.
        help: the line of help.
        flags: names of the option; by default the field's own with two dashes.
        metavar: what stands for its value in the help.
        read: makes the field's value of what is given.
        shown: whether the help shows the default.
    """

    takes: Any
    help: str
    flags: tuple[str, ...] = ()
    metavar: str | None = None
    read: Callable[[Any], Any] | None = None
    shown: bool = True


def option(
    default: Any,
    takes: Any,
    help: str,
    *flags: str,
    metavar: str | None = None,
    read: Callable[[Any], Any] | None = None,
    shown: bool = True,
) -> Any:
    """A field that the command line offers; see ``OnCommandLine``."""
    return field(default=default, metadata={"offer": OnCommandLine(takes, help, flags, metavar, read, shown)})


def offered(options: type[Any]) -> dict[str, OnCommandLine]:
    """Fields of a class that the command line offers, in their order."""
    return {f.name: f.metadata["offer"] for f in fields(options) if "offer" in f.metadata}


def with_changes(kind: type[T], options: T | None, changes: Mapping[str, Any]) -> T:
    """Options, by default those of the class, with other values of some fields.

    Raises:
        ConfigError: for options of another verb, a name that is no field, or a value that cannot be.
    """
    if options is not None and not isinstance(options, kind):
        raise ConfigError(f"options are {type(options).__name__}, expected {kind.__name__}")
    known = [f.name for f in fields(kind)]  # type: ignore[arg-type]
    for name in changes:
        if name not in known:
            raise ConfigError(unknown_name("option", name, known))
    return replace(options if options is not None else kind(), **changes)  # type: ignore[type-var]


def bounds_of(items: Iterable[str]) -> dict[str, tuple[float, float]]:
    """``NAME=LOW,HIGH`` texts as a table.

    Raises:
        ConfigError: where a text is not of that form.
    """
    table = {}
    for item in items:
        name, equals, text = item.partition("=")
        low, comma, high = text.partition(",")
        try:
            limits = (float(low), float(high))
        except ValueError:
            comma = ""
        if not (name and equals and comma):
            raise ConfigError(f"--bound {item!r}: expected name=low,high, such as maa.area=3e-4,5e-4")
        table[name.strip()] = limits
    return table


def key_values(items: Iterable[str] | None, flag: str) -> dict[str, str]:
    """``key=value`` texts as a table.

    Raises:
        ConfigError: where a text is not of that form.
    """
    table: dict[str, str] = {}
    for item in items or []:
        key, equals, value = item.partition("=")
        if not equals or not key:
            raise ConfigError(f"{flag} {item!r}: expected key=value, such as duration=10")
        table[key.strip()] = value.strip()
    return table


def _set_of(items: Iterable[str]) -> dict[str, str]:
    return key_values(items, "--set")


def _settings_of(items: Iterable[str]) -> dict[str, Path]:
    return {name: Path(file) for name, file in key_values(items, "--settings").items()}


def _shares_of(percents: Iterable[float]) -> tuple[float, ...]:
    return tuple(sorted({percent / 100 for percent in percents}))


NAMES, SPAN = list[str] | None, tuple[float, float] | None


def _select() -> Any:
    text = "Use the trials of these names only, such as 'step_*'."
    return option(None, NAMES, text, metavar="PATTERN")


def _window(text: str) -> Any:
    return option(None, SPAN, text, metavar="FROM TO")


def _engine() -> Any:
    text = "reduced (compiled equations of motion) or mujoco; by default reduced where it covers the whole robot."
    return option(None, str | None, text)


def _dt() -> Any:
    return option(None, float | None, "Physics step, in s; the engine's own by default.")


def _threads(text: str = "Of the simulations; all cores by default.") -> Any:
    return option(None, int | None, text)


def _bounds() -> Any:
    text = "Bounds of a parameter, in SI units."
    return option(None, NAMES, text, "--bound", metavar="NAME=LOW,HIGH", read=bounds_of)


def _parameters() -> Any:
    text = "File (TOML) of the parameters to estimate, see list parameters --write."
    return option(None, Path | None, text, metavar="FILE")


def _at_least(name: str, value: float | None, least: float) -> None:
    if value is not None and value < least:
        raise ConfigError(f"{name} is {value}, expected at least {least}")


@dataclass(frozen=True)
class DiagnoseOptions:
    """How a diagnosis is made.

    Attributes:
        free: names or patterns of the parameters to estimate; stiffness, area, rest length and damping by default.
        fix: names or patterns of parameters to keep at their values all the same.
        bounds: (low, high) of some of them.
        parameters: file that says what is free, see ``workflow.mjcf.read_free``; ``free`` adds, ``bounds`` win.
        select: patterns of the names of the trials to use; all by default.
        validation: patterns of the names of trials by which effects are confirmed or rejected; see
            ``diagnosis.holdout.split`` for the default.
        test: patterns of the names of trials that no fit and no choice sees.
        until: of every trial only what comes before this time is fitted; the rest is held out [s].
        window: (from, to) of each trial that counts at all [s].
        shoot: length of multiple-shooting intervals where nothing holds the robot in place [s]; see
            ``diagnosis.holdout.longest_interval``.
        most: largest number of effects, 1 to 6.
        exclude: names of effects that are not tried.
        engine: ``"reduced"`` or ``"mujoco"``; by default see ``engines.choice.engine_for``.
        threads: of the simulations; all cores by default.
        budget: how long it may take; its best so far is given then. As long as it needs by default [s].
        by: ``"folder"`` where the trials of each folder are another unit of the robot, or of another day: one model is
            found for all, with what differs between them; None where all are alike.

    Raises:
        ConfigError: for a value that cannot be.
    """

    validation: Sequence[str] = option(
        (),
        NAMES,
        "Trials by which effects are confirmed or rejected, by name; every fourth by default, the end of a single one.",
        metavar="PATTERN",
    )
    test: Sequence[str] = option(
        (),
        NAMES,
        "Trials that no fit and no choice sees, by name; by default half of every fourth, from 8 trials on.",
        metavar="PATTERN",
    )
    until: float | None = option(
        None, float | None, "Fit each trial up to this time only; the rest is held out.", metavar="SECONDS"
    )
    select: Sequence[str] | None = _select()
    window: Window | None = _window("Use this part of each trial only, in s.")
    free: Sequence[str] | None = option(
        None,
        NAMES,
        "Parameters to estimate, such as '*.mass', or base_parameters; by default the least certain ones, see list "
        "parameters.",
        metavar="NAME",
    )
    fix: Sequence[str] = option((), NAMES, "Parameters to keep at their values all the same.", metavar="NAME")
    bounds: Bounds | None = _bounds()
    parameters: Path | None = _parameters()
    shoot: float | None = option(
        None,
        float | None,
        "Of an MJCF robot: length of the multiple-shooting intervals, each with a free initial state; by default as "
        "long as the nominal model's predictions stay close.",
        metavar="SECONDS",
    )
    most: int = option(3, int, "Largest number of effects in a hypothesis.")
    exclude: Sequence[str] = option((), NAMES, "Do not try this effect, see list effects.", metavar="EFFECT")
    engine: EngineName | None = _engine()
    threads: int | None = _threads()
    budget: float | None = option(
        None,
        float | None,
        "Give the best so far after this time, with what was not tried.",
        metavar="SECONDS",
    )
    by: Literal["folder"] | None = option(
        None,
        str | None,
        "folder: the trials of each folder are another unit of the robot, or of another day; what differs between them "
        "is told.",
        metavar="folder",
    )

    def __post_init__(self) -> None:
        """Check the values."""
        if self.by not in (None, *GROUPINGS):
            raise ConfigError(unknown_name("grouping", str(self.by), GROUPINGS, "by"))
        if not 1 <= self.most <= 6:
            raise ConfigError(f"the largest number of effects is {self.most}, expected 1 to 6")
        if self.until is not None and not math.isfinite(self.until):
            raise ConfigError(f"the end of what is fitted is {self.until:g} s, expected a finite time")
        _at_least("threads", self.threads, 1)


@dataclass(frozen=True)
class IdentifyOptions:
    """How parameters are identified from trials, poses at rest, or both.

    Attributes:
        free: names or patterns of the parameters to estimate; stiffness, area, rest length and damping by default, of
            poses at rest the first three.
        fix: names or patterns of parameters to keep at their values all the same.
        bounds: (low, high) of some of them.
        select: patterns of the names of the trials to use; all by default.
        parameters: file that says what is free, see ``workflow.mjcf.read_free``; ``free`` adds, ``bounds`` win.
        heldout: held-out files, folders, trials or poses; those that take part in the fit are dropped.
        window: (from, to) of each trial that is compared; all of it by default [s].
        shoot: length of multiple-shooting intervals, each with a free initial state [s].
        fit_start: estimate each trial's first angles too.
        engine: ``"reduced"`` or ``"mujoco"``; by default see ``engines.choice.engine_for``.
        dt: physics step [s].
        folds: of the k-fold cross-validation; less than two for none.
        threads: all cores by default.
        settings: how it searches.

    Raises:
        ConfigError: for a value that cannot be.
    """

    free: Sequence[str] | None = option(
        None,
        NAMES,
        "Parameters to estimate, such as 'maa.*', or base_parameters; by default the least certain ones.",
        metavar="NAME",
    )
    fix: Sequence[str] = option((), NAMES, "Parameters to keep at their values all the same.", metavar="NAME")
    bounds: Bounds | None = _bounds()
    select: Sequence[str] | None = _select()
    parameters: Path | None = _parameters()
    heldout: Some | Sequence[StaticPoses] = option(
        (),
        list[Path] | None,
        "Held-out trials or poses; those that are fitted are dropped.",
        metavar="PATH",
    )
    window: Window | None = _window("Use this part of each trial only, in s.")
    shoot: float | None = option(
        None, float | None, "Length of multiple-shooting intervals, each with a free initial state.", metavar="SECONDS"
    )
    fit_start: bool = option(False, bool, "Estimate each trial's first angles too.", "--fit-start")
    engine: EngineName | None = _engine()
    dt: float | None = _dt()
    folds: int = option(4, int, "Of the k-fold cross-validation; 0 for none.")
    threads: int | None = _threads()
    settings: FitSettings | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        if self.folds < 0:
            raise ConfigError(f"the cross-validation has {self.folds} folds, expected 0 or more")
        _at_least("threads", self.threads, 1)

    def given(self, names: Iterable[str]) -> list[str]:
        """Those of some fields that have another value than by default."""
        default = type(self)()
        return [name for name in names if getattr(self, name) != getattr(default, name)]


@dataclass(frozen=True)
class ProveOptions:
    """How the diagnosis is put to the proof.

    Attributes:
        cases: how many robots.
        seed: of everything random.
        kind: of all ground truths, one of ``proof.drawing.Kind``; drawn for each by default.
        trials: of each leg; ``proof.designs.TRIALS`` by default.
        duration: of each leg's trials; ``proof.designs.DURATION`` by default [s].
        workers: processes at a time; as many as there are processors by default.
        baselines: whether simpler methods are given the same cases; by default those of legs, for which alone they are.

    Raises:
        ConfigError: for a value that cannot be.
    """

    cases: int = option(100, int, "How many robots.")
    seed: int = option(0, int, "Of everything random.")
    kind: str | None = option(
        None,
        str | None,
        "none, single, pair, outside or all_joints (friction in each) for all; by default a mixture of the first four.",
        metavar="KIND",
    )
    trials: int | None = option(None, int | None, "Recorded of each leg; 8 by default.", shown=False)
    duration: float | None = option(
        None, float | None, "Of each leg's trials; 12 by default.", metavar="SECONDS", shown=False
    )
    workers: int | None = option(None, int | None, "Processes at a time; one a processor by default.")
    baselines: bool | None = option(
        None,
        bool | None,
        "Give simpler methods the same recordings; with legs they are by default.",
        shown=False,
    )

    def __post_init__(self) -> None:
        """Check the values."""
        _at_least("cases", self.cases, 1)
        _at_least("seed", self.seed, 0)
        _at_least("trials", self.trials, 1)
        _at_least("workers", self.workers, 1)
        if self.kind is not None and self.kind not in KINDS:
            raise ConfigError(unknown_name("kind of ground truth", self.kind, KINDS))
        if self.duration is not None and not LEAST_DURATION <= self.duration < math.inf:
            raise ConfigError(f"duration is {self.duration:g} s, expected at least {LEAST_DURATION:g} s")


@dataclass(frozen=True)
class ScoreOptions:
    """How a model is judged by recordings, open loop.

    Attributes:
        engine: ``"reduced"`` or ``"mujoco"``; by default see ``engines.choice.engine_for``.
        window: (from, to) of each trial that counts; all of it by default [s].
        rate: of a grid to compare on; the recording's own rows by default [Hz].

    Raises:
        ConfigError: for a value that cannot be.
    """

    engine: EngineName | None = _engine()
    window: Window | None = _window("Score this part of each trial, in s.")
    rate: float | None = option(
        None, float | None, "Compare on a grid of this rate, in Hz; at the recorded rows by default."
    )

    def __post_init__(self) -> None:
        """Check the values."""
        if self.rate is not None and not 0 < self.rate <= MOST_RATE:
            raise ConfigError(
                f"the rate of the grid is {self.rate:g} Hz, expected more than 0 and at most {MOST_RATE:g}"
            )


@dataclass(frozen=True)
class SensitivityOptions:
    """How it is found which numbers of a model matter to its predictions.

    Attributes:
        parameters: names or patterns; all by default.
        shares: by which each is changed; ``identification.sensitivity.SHARES`` by default.
        select: patterns of the names of the trials to use; all by default.
        window: (from, to) of each trial that is compared; all of it by default [s].
        engine: ``"reduced"`` or ``"mujoco"``; by default see ``engines.choice.engine_for``.
        dt: physics step [s].
        threads: all cores by default.

    Raises:
        ConfigError: for a value that cannot be.
    """

    parameters: Sequence[str] = option(
        ("*",), NAMES, "Which, such as 'baa.*'; all by default.", "--parameter", metavar="NAME"
    )
    shares: Sequence[float] | None = option(
        None,
        list[float] | None,
        "By how much each is changed; ±1, ±5 and ±10 by default.",
        "--share",
        metavar="PERCENT",
        read=_shares_of,
    )
    select: Sequence[str] | None = _select()
    window: Window | None = _window("Use this part of each trial only, in s.")
    engine: EngineName | None = _engine()
    dt: float | None = _dt()
    threads: int | None = _threads()

    def __post_init__(self) -> None:
        """Check the values."""
        _at_least("threads", self.threads, 1)


@dataclass(frozen=True)
class ValidateOptions:
    """How the physics is validated.

    Attributes:
        quick: fewer runs of everything, see ``validation.plan.QUICK``.
        seed: of everything random.
        threads: at most; all cores by default. Changes no error.

    Raises:
        ConfigError: for a value that cannot be.
    """

    quick: bool = option(False, bool, "Fewer runs of everything, no front: half a minute.", "--quick")
    seed: int = option(0, int, "Of everything random.")
    threads: int | None = _threads("At most; all cores by default. Changes no error.")

    def __post_init__(self) -> None:
        """Check the values."""
        _at_least("seed", self.seed, 0)
        _at_least("threads", self.threads, 1)


@dataclass(frozen=True)
class AutotuneOptions:
    """How the PID is tuned, beside what a study says.

    Attributes:
        scenarios: objectives in place of the study's own, each of the same weight.
        candidates: sets of gains to try in all, in place of the study's number.
        seed: of the search, the ensemble and the noise, in place of the study's.
        output: settings file to write; ``controllers/pid.toml`` by default.
        folder: of the record and the journal; ``tuning/results/<study>`` by default.
        recordings: folder that scenarios may take recordings from; none by default, so that the same command gives the
            same gains whether recordings are at hand or not.
        fresh: do not take up an interrupted run.
        workers: threads; all cores by default.

    Raises:
        ConfigError: for a value that cannot be.
    """

    scenarios: Sequence[str] = option(
        (), NAMES, "Objective in place of the study's own; may be repeated.", "--scenario"
    )
    candidates: int | None = option(None, int | None, "Sets of gains to try in all.")
    seed: int | None = option(None, int | None, "Of the search, the ensemble and the noise.")
    output: Path | None = option(
        None, Path | None, "Settings file to write; controllers/pid.toml by default.", "--output", "-o"
    )
    folder: Path | None = option(
        None, Path | None, "Folder for record, journal and figures; tuning/results/<study> by default.", "--results"
    )
    recordings: Path | None = option(
        None, Path | None, "Folder that scenarios may take recordings from; none by default.", metavar="DIR"
    )
    fresh: bool = option(False, bool, "Start anew instead of going on where a run stopped.", "--fresh")
    workers: int | None = _threads("Threads; all cores by default.")

    def __post_init__(self) -> None:
        """Check the values; what a study may say is checked as a study's."""
        _at_least("workers", self.workers, 1)


@dataclass(frozen=True)
class CompareOptions:
    """How controllers are compared.

    Attributes:
        controllers: names, ``path.py:Name``, controllers, classes or functions; all that are made for it by default.
        under: names of ``workflow.comparisons.CONDITIONS``, or conditions; by default the first ones, and with a
            corrected model the last ones too.
        draws: how many perturbed robots.
        scenario_options: of the scenarios, as text.
        settings: controller → its settings file.
        seed: of noise and perturbed robots.
        recordings: folder to look for recordings in.

    Raises:
        ConfigError: for a value that cannot be.
    """

    controllers: Sequence[str | Controller | Callable[..., Any]] | None = option(
        None,
        NAMES,
        "By name or path/to/file.py:Name; repeatable. By default pid, lqr, nmpc, sampling, those of plugins.",
        "--controller",
        "-c",
    )
    under: Sequence[str | Condition] | None = option(
        None,
        NAMES,
        "nominal, noisy, delayed, unmodelled_delay, perturbed, corrected or uncorrected; repeatable.",
        "--condition",
        metavar="NAME",
    )
    draws: int = option(3, int, "How many perturbed robots.")
    scenario_options: Mapping[str, str] | None = option(
        None, NAMES, "An option of the scenarios.", "--set", metavar="KEY=VALUE", read=_set_of
    )
    settings: Mapping[str, Path] | None = option(
        None, NAMES, "Settings file of a controller (TOML); repeatable.", metavar="NAME=FILE", read=_settings_of
    )
    seed: int = option(0, int, "Of noise and perturbed robots.")
    recordings: Path | None = option(
        None, Path | None, "Folder with recordings; $EQUIMUS_RECORDINGS by default.", metavar="DIR"
    )

    def __post_init__(self) -> None:
        """Check the values."""
        _at_least("draws", self.draws, 1)
        _at_least("seed", self.seed, 0)


MOST_RATE = 1e5
"""Of the grid that predictions are compared on [Hz]; nothing is recorded faster."""
KINDS = ("none", "single", "pair", "outside", "all_joints")
"""Of ground truths; see ``proof.drawing.Kind``."""
LEAST_DURATION = 2.0
"""Of a proof's trial; a shorter one does not move the leg enough [s]."""
