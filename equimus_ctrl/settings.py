"""Settings as tables of TOML: numbers, switches, words and tables of the same."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from types import NoneType
from typing import Any, ClassVar, Self, TypeVar, get_args, get_type_hints

from equimus_ctrl.errors import ConfigError, unknown_name

T = TypeVar("T")


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
