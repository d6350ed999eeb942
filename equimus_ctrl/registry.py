"""Things known by name, to which a user's own files may add."""

from __future__ import annotations

from typing import TypeVar

from equimus_ctrl.errors import ConfigError, EquimusError, unknown_name

T = TypeVar("T")


class Registry(dict[str, T]):
    """Name → entry, of one kind of thing.

    Args:
        kind: what its entries are, for messages.
        unknown: what is raised for a name that there is not.
    """

    def __init__(self, kind: str, unknown: type[EquimusError] = ConfigError) -> None:
        super().__init__()
        self.kind, self._unknown = kind, unknown

    def add(self, name: str, entry: T) -> None:
        """Make an entry known.

        Raises:
            ConfigError: where the name is no plain one, or another's.
        """
        if not name.isidentifier():
            raise ConfigError(
                f"{self.kind} {name!r}: expected a plain name of letters, digits and '_' that begins with no digit"
            )
        if name in self:
            raise ConfigError(f"{self.kind} {name}: there is one of that name already")
        self[name] = entry

    def entry(self, name: str) -> T:
        """What is known by a name, or the error given with the names that there are."""
        if name not in self:
            raise self._unknown(unknown_name(self.kind, name, self))
        return self[name]
