"""Settings as tables of TOML: numbers, switches, words and tables of the same."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import Field, field, fields, is_dataclass, replace
from types import NoneType
from typing import Any, ClassVar, Self, TypeVar, get_args, get_type_hints

from equimus_ctrl.errors import ConfigError, unknown_name

T = TypeVar("T")
ONLY = "only"
"""Of a field's metadata: what a setting is for alone."""
PRESSURES, OTHERS = "commands that are pressures", "commands that are no pressures"
"""What some settings are for: acceptable deviations in pressures, and what they follow from on any other robot."""


def setting(default: T, only: str) -> T:
    """A field of settings that changes nothing but where something is so.

    Args:
        default: its value.
        only: what it is for, in words that stand after *is for*.
    """
    found: T = field(default=default, metadata={ONLY: only})
    return found


def both(one: str, other: str) -> str:
    """Two notes for a person, either of which may be empty."""
    return "; ".join(part for part in (one, other) if part)


def settings_from(cls: type[T], data: Mapping[str, Any], where: str, form: str | None = None) -> T:
    """Settings of a dataclass whose fields are floats, integers, switches, words, None or such dataclasses.

    Args:
        cls: a frozen dataclass that checks its own values.
        data: what a table holds; keys that are missing keep their defaults.
        where: for messages.
        form: what ``format`` has to say where it is there.

    Raises:
        ConfigError: for a key that there is not or a value of the wrong kind or size, in a sentence with ``where``.
    """
    try:
        return cls(**_values(cls, data, where, form))
    except ConfigError as error:
        raise ConfigError(str(error) if str(error).startswith(where) else f"{where}: {error}") from None


def _values(cls: type, data: Mapping[str, Any], where: str, form: str | None = None) -> dict[str, Any]:
    kinds = get_type_hints(cls)
    known = {f.name: f for f in fields(cls)}
    values: dict[str, Any] = {}
    for key, value in data.items():
        if key == "format" and form is not None:
            if value != form:
                raise ConfigError(f"{where}: format is {value!r}, expected {form!r}")
        elif key not in known:
            raise ConfigError(unknown_name("key", key, known, where))
        elif is_dataclass(kinds[key]):
            if not isinstance(value, Mapping):
                raise ConfigError(f"{where}: {key} is {value!r}, expected a table")
            make = known[key].default_factory
            assert callable(make)  # settings within settings have defaults
            values[key] = replace(make(), **_values(kinds[key], value, f"{where}: {key}"))
        else:
            values[key] = _checked(kinds[key], value, f"{where}: {key}")
    return values


def _checked(kind: Any, value: Any, where: str) -> Any:
    kind = next((own for own in get_args(kind) if own is not NoneType), kind)  # a file leaves out what is None
    wanted = {bool: "true or false", int: "a whole number", float: "a number"}.get(kind, "a word")
    fits = {
        bool: isinstance(value, bool),
        int: isinstance(value, int) and not isinstance(value, bool),
        float: isinstance(value, int | float) and not isinstance(value, bool),
    }.get(kind, isinstance(value, str))
    if not fits:
        raise ConfigError(f"{where} is {value!r}, expected {wanted}")
    return float(value) if kind is float else value


def table_of(settings: Any, form: str | None = None) -> dict[str, Any]:
    """What a TOML file of such settings holds."""
    values = {f.name: value for f in fields(settings) if (value := getattr(settings, f.name)) is not None}
    table = {key: table_of(value) if is_dataclass(value) else value for key, value in values.items()}
    return {"format": form, **table} if form is not None else table


class FileSettings:
    """Settings that a TOML file holds; for dataclasses.

    Attributes:
        form: what the file's ``format`` says.
    """

    form: ClassVar[str]

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], where: str | None = None) -> Self:
        """From what a TOML file holds.

        Raises:
            ConfigError: for a key that there is not, or a value that does not fit, in a sentence with ``where``.
        """
        return settings_from(cls, data, where or cls.__name__, cls.form)

    def to_dict(self) -> dict[str, Any]:
        """What a TOML file of these settings holds."""
        return table_of(self, self.form)

    def idle(self, there: Collection[str]) -> dict[str, str]:
        """Dotted name → what it is for, of settings that differ from their defaults and change nothing.

        Args:
            there: what is so, see ``setting``.
        """
        return {
            name: own.metadata[ONLY]
            for name, own, value, first in _each(self)
            if own.metadata.get(ONLY) not in (None, *there) and value != first
        }

    def check_idle(self, there: Collection[str], who: str, robot: str) -> None:
        """Nothing where each setting that somebody chose has an effect.

        Args:
            there: what is so, see ``setting``.
            who: whose settings they are.
            robot: its name.

        Raises:
            ConfigError: where some have none.
        """
        idle = self.idle(there)
        able = [name for name, own, _, _ in _each(self) if own.metadata.get(ONLY) in (None, *there)]
        for only in dict.fromkeys(idle.values()):
            names = [name for name, own in idle.items() if own == only]
            raise ConfigError(
                f"{who}: {', '.join(names)} {'is' if len(names) == 1 else 'are'} for {only}, and would change nothing "
                f"of {robot}; what can be set there is {', '.join(able)}"
            )

    def suited(self, there: Collection[str], who: str, robot: str, shared: str) -> tuple[Self, str]:
        """The same for a robot, and what has to be said of them.

        Of a file that all robots share, what would change nothing is left as by default, and told.

        Args:
            there: what is so, see ``setting``.
            who: whose settings they are.
            robot: its name.
            shared: that file; empty where somebody chose these settings for the robot.

        Raises:
            ConfigError: where somebody chose one that changes nothing.
        """
        if not shared:
            self.check_idle(there, who, robot)
            return self, ""
        idle = self.idle(there)
        said = f"{shared}: {', '.join(idle)} left aside, for {robot} has no use for it" if idle else ""
        return _reset(self, idle), said


def _each(settings: Any, before: str = "", first: Any = None) -> Iterator[tuple[str, Field[Any], Any, Any]]:
    """(dotted name, field, value, default) of settings and those within them, whose defaults are those of ``first``."""
    for own in fields(settings):
        value = getattr(settings, own.name)
        usual = own.default if first is None else getattr(first, own.name)
        if is_dataclass(value):
            assert callable(own.default_factory)  # settings within settings have defaults
            yield from _each(value, f"{before}{own.name}.", own.default_factory())
        else:
            yield before + own.name, own, value, usual


def _reset(settings: Any, names: Collection[str]) -> Any:
    """Settings, those of some dotted names as by default."""
    found: dict[str, dict[str, Any]] = {}
    for name, _, _, first in _each(settings):
        if name in names:
            table, _, key = name.rpartition(".")
            found.setdefault(table, {})[key] = first
    inner = {key: replace(getattr(settings, key), **own) for key, own in found.items() if key}
    return replace(settings, **{**found.get("", {}), **inner})
