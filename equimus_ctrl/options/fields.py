"""Options that several verbs have, and how what is given on the command line becomes their values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.options.offers import option

if TYPE_CHECKING:
    from equimus_ctrl.types import Recording

    Some = Path | str | Iterable[Path | str | Recording]
    Window = tuple[float, float]
    Bounds = Mapping[str, tuple[float, float]]


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


def set_of(items: Iterable[str]) -> dict[str, str]:
    """``--set`` as a table."""
    return key_values(items, "--set")


def settings_of(items: Iterable[str]) -> dict[str, Path]:
    """``--settings`` as a table of files."""
    return {name: Path(file) for name, file in key_values(items, "--settings").items()}


def shares_of(percents: Iterable[float]) -> tuple[float, ...]:
    """Percents as shares, in order."""
    return tuple(sorted({percent / 100 for percent in percents}))


NAMES, SPAN = list[str] | None, tuple[float, float] | None


def select_option() -> Any:
    """Which trials."""
    text = "Use the trials of these names only, such as 'step_*'."
    return option(None, NAMES, text, metavar="PATTERN")


def mapping_option() -> Any:
    """What the columns of files of other formats are."""
    text = "File (TOML) that says what the columns of files of other formats are."
    return option(None, Path | None, text, "--map", metavar="FILE")


def window_option(text: str) -> Any:
    """A part of each trial."""
    return option(None, SPAN, text, metavar="FROM TO")


def engine_option() -> Any:
    """Which engine."""
    text = "reduced (compiled equations of motion) or mujoco; by default reduced where it covers the whole robot."
    return option(None, str | None, text)


def dt_option() -> Any:
    """Which physics step."""
    return option(None, float | None, "Physics step, in s; the engine's own by default.")


def threads_option(text: str = "Of the simulations; all cores by default.") -> Any:
    """How many threads."""
    return option(None, int | None, text)


def bounds_option() -> Any:
    """Bounds of parameters."""
    text = "Bounds of a parameter, in SI units."
    return option(None, NAMES, text, "--bound", metavar="NAME=LOW,HIGH", read=bounds_of)


def parameters_option() -> Any:
    """A file of free parameters."""
    text = "File (TOML) of the parameters to estimate, see list parameters --write."
    return option(None, Path | None, text, metavar="FILE")


def also_option() -> Any:
    """What is compared beside joint positions."""
    text = "Recorded columns that are compared beside joint positions, such as 'vel.*', 'meas.*' or 'site.tip.x'."
    return option((), NAMES, text, metavar="COLUMN")


def zero_option() -> Any:
    """Joints whose sensors have another zero in each trial."""
    text = "A joint whose sensor has another, unknown zero in each trial, such as 'elbow' or '*'."
    return option((), NAMES, text, metavar="JOINT")


def workers_option(text: str = "Processes at a time; one a processor by default.") -> Any:
    """How many processes of this computer."""
    return option(None, int | None, text)


def scheduler_option() -> Any:
    """A Dask cluster in their place."""
    text = "Work on the Dask cluster of this scheduler, such as tcp://head:8786."
    return option(None, str | None, text, metavar="ADDRESS")


def slurm_option() -> Any:
    """Jobs of a Slurm cluster in their place."""
    text = "Work in jobs of a Slurm cluster; the file (TOML) says how they are asked for."
    return option(None, Path | None, text, metavar="FILE")


def check_where(workers: int | None, scheduler: str | None, slurm: Path | None) -> None:
    """Raise ConfigError where these do not say in one way where work is done."""
    counted("workers", workers)
    given = {"--workers": workers, "--scheduler": scheduler, "--slurm": slurm}
    names = [name for name, value in given.items() if value is not None]
    if len(names) > 1:
        raise ConfigError(f"{' and '.join(names)} are given, expected one: each says where the work is done")
    if scheduler is not None and not all(scheduler.partition("://")):
        raise ConfigError(f"scheduler is {scheduler!r}, expected an address such as tcp://head:8786")


MOST = 1_000_000
"""Of anything that is counted: robots, trials, processes. Each takes memory before the first is done."""


def at_least(name: str, value: float | None, least: float) -> None:
    """Raise ConfigError for a value below the least."""
    if value is not None and value < least:
        raise ConfigError(f"{name} is {value}, expected at least {least}")


def counted(name: str, value: int | None, least: int = 1) -> None:
    """Raise ConfigError for a number of something that is below the least, or more than any computer holds."""
    at_least(name, value, least)
    if value is not None and value > MOST:
        raise ConfigError(f"{name} is {value}, expected at most {MOST:,}")
