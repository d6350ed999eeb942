"""How much each number of a model matters to its predictions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.engines.base import Engine
from equimus_ctrl.errors import ConfigError, ModelError, SimulationDiverged
from equimus_ctrl.frames import dataframe
from equimus_ctrl.identification.parameters import default_bounds, matching, unit_of
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator, simulator_for
from equimus_ctrl.models.model import Model
from equimus_ctrl.shown import Short, counted
from equimus_ctrl.types import Array

if TYPE_CHECKING:
    from pandas import DataFrame

SHARES = (-0.10, -0.05, -0.01, 0.01, 0.05, 0.10)
SCHEMA = "equimus-ctrl/sensitivity/1"
COMMAND_RANGE = ("command_low", "command_high")
LOCAL = 1e-4
"""Share of a parameter by which the local sensitivity's central differences step."""


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivity(Short):
    """Errors of a model with one parameter changed at a time.

    Attributes:
        model: the nominal model.
        names: of the parameters, the most sensitive first.
        units: of each.
        reference: (p,) what a share is of: the parameter itself, or a typical range where it is zero.
        shares: (k,) by which each was changed.
        rmse: (p, k, nj) error against the measurements [rad]; nan where that model cannot be or diverges.
        diverged: (p, k) where it can be, but its simulation diverges.
        base: (nj,) error of the initial model [rad].
        local: (p, nj) root mean square change of the predictions for a change of one per cent, to first order [rad].
        engine: that simulated.
    """

    model: Model
    names: tuple[str, ...]
    units: tuple[str, ...]
    reference: Array
    shares: Array
    rmse: Array
    diverged: NDArray[np.bool_]
    base: Array
    local: Array
    engine: Engine

    def told(self) -> str:
        """The parameters that matter most."""
        return f" of {self.model.name} to {counted(len(self.names), 'parameter')}: most to {', '.join(self.names[:3])}"

    def to_dataframe(self) -> DataFrame:
        """A row for each parameter, the most sensitive first: what 1 % of it changes in each joint [rad or m].

        Raises:
            NotAvailable: where pandas is not installed.
        """
        joints = {name: self.local[:, j] for j, name in enumerate(self.model.robot.joint_names)}
        own = {"parameter": list(self.names), "unit": list(self.units), "reference": self.reference}
        return dataframe({**own, **joints}, "parameter")

    def to_dict(self) -> dict[str, Any]:
        """Plain types; angles in rad, null where there is no number."""
        joints = self.model.robot.joint_names

        def row(values: Array) -> dict[str, float | None]:
            return {j: float(v) if np.isfinite(v) else None for j, v in zip(joints, values, strict=True)}

        return {
            "schema": SCHEMA,
            "model": self.model.name,
            "engine": self.engine.to_dict(),
            "rmse_rad": row(self.base),
            "shares": [float(share) for share in self.shares],
            "parameters": [
                {
                    "name": name,
                    "unit": self.units[i],
                    "reference": float(self.reference[i]),
                    "local_rad_per_cent": row(self.local[i]),
                    "changes": [
                        {"share": float(share), "rmse_rad": row(self.rmse[i, k]), "diverged": bool(self.diverged[i, k])}
                        for k, share in enumerate(self.shares)
                    ],
                }
                for i, name in enumerate(self.names)
            ],
        }


def sensitivity(
    model: Model,
    segments: Sequence[Segment],
    *,
    patterns: Sequence[str] = ("*",),
    shares: Sequence[float] = SHARES,
    simulator: Simulator | None = None,
    notify: Callable[[float], None] = lambda share: None,
) -> Sensitivity:
    """Change every number by given shares and compare with what was measured.

    Args:
        model: to start from.
        segments: what was measured.
        patterns: of the parameters to change; the limits of the command are never among them.
        shares: by which to change them.
        simulator: the engine; the reduced one by default.
        notify: called with the share done.

    Raises:
        ConfigError: for a pattern that means nothing, or shares that are none.
        SimulationDiverged: where the initial model does.
    """
    if not shares:
        raise ConfigError("no share was given to change the parameters by")
    for share in shares:
        if share == 0 or not np.isfinite(share):
            raise ConfigError(
                f"a share to change the parameters by is {share:g}, expected a finite number other than 0"
            )
    names = [n for n in matching(model, patterns) if n not in COMMAND_RANGE]
    if not names:
        raise ConfigError(f"{' and '.join(COMMAND_RANGE)} only clip commands; no prediction depends on them")
    values = model.parameters()
    reference = np.array([_reference(model, name) for name in names])
    wanted = [
        (name, values[name] + share * size)
        for name, size in zip(names, reference, strict=True)
        for share in (*shares, -LOCAL, LOCAL)
    ]
    models: list[Model] = [model]
    place: list[int | None] = []
    for name, value in wanted:
        try:
            models.append(model.with_parameters({name: value}))
            place.append(len(models) - 1)
        except (ConfigError, ModelError):
            place.append(None)
    simulator = simulator or simulator_for(model)
    width, nj = len(shares) + 2, segments[0].measured.shape[1]
    # The two models of each central difference; the initial model stands in for one that cannot be.
    pairs = np.array([[place[i * width + k] or 0 for k in (width - 2, width - 1)] for i in range(len(names))])
    squares, samples = np.zeros((len(models), nj)), sum(len(s.measured) for s in segments)
    change = np.zeros((len(names), nj))
    sound = np.ones(len(models), dtype=bool)
    for done, segment in enumerate(segments):
        (found,) = simulator(models, [segment], [np.tile(segment.start, (len(models), 1))])
        with np.errstate(invalid="ignore", over="ignore"):  # what diverges counts for nothing below
            position = found.position[:, :, :nj]
            squares += ((position - segment.measured) ** 2).sum(axis=1)
            change += ((position[pairs[:, 1]] - position[pairs[:, 0]]) ** 2).sum(axis=1)
        if not found.sound[0]:
            raise SimulationDiverged(
                f"{segment.trial.name}: the simulation of {model.name} diverges with the nominal model"
            )
        sound &= found.sound
        notify((done + 1) / len(segments))
    rmse = np.where(sound[:, None], np.sqrt(squares / samples), np.nan)
    table = np.full((len(names), len(shares), nj), np.nan)
    diverged = np.zeros((len(names), len(shares)), dtype=bool)
    for i in range(len(names)):
        for k, index in enumerate(place[i * width : i * width + len(shares)]):
            if index is not None:
                table[i, k], diverged[i, k] = rmse[index], not sound[index]
    steps = LOCAL * np.count_nonzero(pairs, axis=1)
    known = (steps > 0) & sound[pairs].all(axis=1)
    local = np.full((len(names), nj), np.nan)
    local[known] = np.sqrt(change[known] / samples) * (0.01 / steps[known])[:, None]
    order = np.argsort(-np.nan_to_num(local.max(axis=1)), kind="stable")
    return Sensitivity(
        model,
        tuple(names[i] for i in order),
        tuple(unit_of(model, names[i]) for i in order),
        reference[order],
        np.array(shares),
        table[order],
        diverged[order],
        rmse[0],
        local[order],
        simulator.engine,
    )


def _reference(model: Model, name: str) -> float:
    value = model.parameters()[name]
    if value != 0:
        return abs(value)
    low, high = default_bounds(model, name)
    return (high - low) / 2
