"""Trials with what models predict of them, as channels that other programs show."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from equimus_ctrl.presets import plain_name
from equimus_ctrl.recordings import csvfile
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array, Recording

GROUPS = {"cmd": "command", "pos": "measured/position", "vel": "measured/velocity", "meas": "measured/actuator"}
SITES = "measured/site"
LIBRARY = "equimus-ctrl"
"""Who wrote a file."""


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Short):
    """What a model predicts of a trial.

    Attributes:
        model: ``nominal``, ``refitted`` or ``augmented``.
        position: (n, nj) at the trial's times [rad or m].
    """

    model: str
    position: Array


@dataclass(frozen=True, eq=False, repr=False)
class Exported(Short):
    """A trial and what models predict of it.

    Attributes:
        recording: the trial.
        predictions: of models.
        units: column of the recording → SI unit.
    """

    recording: Recording
    predictions: tuple[Prediction, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def folder(self) -> str:
        """What topics of the trial begin with."""
        return f"/{plain_name(self.recording.name)}"

    def series(self) -> Iterator[tuple[str, dict[str, Array], dict[str, str]]]:
        """(topic, field → (n,) values, field → column of the recording that it is) of each channel."""
        groups: dict[str, dict[str, str]] = {}
        values = dict(csvfile.columns(self.recording))
        for column in values:
            prefix, _, name = column.partition(".")
            if name:
                groups.setdefault(GROUPS.get(prefix, SITES), {})[name] = column
        for group, names in groups.items():
            yield f"{self.folder}/{group}", {name: values[column] for name, column in names.items()}, names
        joints, measured = self.recording.joints, self.recording.position
        for own in self.predictions:
            for what, block in (("position", own.position), ("residual", measured - own.position)):
                yield f"{self.folder}/{own.model}/{what}", {j: block[:, k] for k, j in enumerate(joints)}, {}
