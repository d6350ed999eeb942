"""What the package's controllers declare to be searched: few numbers that matter, about the settings they have untuned.

Regulators have acceptable deviations whose ratios alone count, so that of angles stays as it is. Where settings do not
say acceptable deviations (``controllers.allowances``), all follow from the bandwidth, which is searched then.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from equimus_ctrl.controllers.allowances import allowances
from equimus_ctrl.controllers.lqr import LqrSettings
from equimus_ctrl.controllers.nmpc import NmpcSettings
from equimus_ctrl.controllers.pid_settings import PidSettings
from equimus_ctrl.controllers.placement import Loop, placed_gains
from equimus_ctrl.controllers.sampling_settings import FOLLOWS, SamplingSettings, kind_of
from equimus_ctrl.controllers.search_space import Range, SearchSpace, Table
from equimus_ctrl.effects.sensors import SENSOR_DELAY, sensor_settings
from equimus_ctrl.errors import ControllerError, NotAvailable
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.solved import valves_of
from equimus_ctrl.settings import FileSettings
from equimus_ctrl.types import Array, PlantSpec

PLACED = {name: Range(0.1, 10.0, 1.0) for name in ("kp", "ki", "kd", "derivative_time")}
"""Factors on the gains that the mass matrix places, the same for every joint."""
SPEED = {"kp": 2.0, "ki": 3.0, "kd": 1.0}
"""Powers of the bandwidth in placed gains (``controllers.placement``)."""
ALLOWED = {
    "pressure": (0.05, 10.0),
    "observer.torque": (0.05, 20.0),
    "observer.disturbance": (0.05, 10.0),
    "observer.pressure": (0.05, 10.0),
}
"""Of regulators whose settings say all: factors on these (least, most)."""
BANDWIDTH = 0.25, 3.0
"""Factors on the bandwidth of others (least, most)."""
SAMPLED = {"rate": (0.1, 10.0), "pressure": (0.05, 10.0), "deviation": (0.2, 4.0), "observer.torque": (0.05, 20.0)}
"""Factors of the sampling controller where commands are pressures (least, most)."""
FOLLOWED = {"deviation": (0.2, 4.0)}
"""Along paths of any other robot, beside the bandwidth."""
LOOKED = {"effort": (0.1, 10.0), "energy": (0.1, 10.0), "deviation": (0.1, 2.0), "unexplained": (0.05, 20.0)}
"""Of plans that look where they lead."""


def placed_space(spec: PlantSpec, pose: Array) -> SearchSpace:
    """Of a PID: factors on placed gains.

    Raises:
        ControllerError: where none keep the robot where it is, or no equations hold it.
    """
    try:
        dynamics = Dynamics(Model(spec.model, spec.effects, spec.phase))
    except NotAvailable as error:
        raise ControllerError(str(error)) from None
    placed = placed_gains(dynamics, spec, pose).searched
    driven = np.any(dynamics.authority(pose, np.zeros_like(pose))[0] != 0, axis=1)

    def growth(settings: Table, robot: Model, poses: Sequence[Array], factors: Sequence[float]) -> list[float]:
        own, tried, valve = Dynamics(robot), PidSettings.from_dict(settings), valves_of(robot)
        late = sensor_settings(robot.effects, robot.robot.joint_names)[:, SENSOR_DELAY]
        loops = [Loop(q, own.linear(q), driven, dynamics, valve, spec.control_dt, late) for q in poses]
        return [max(loop.growth(tried, factor)[0] for loop in loops) for factor in factors]

    return SearchSpace(PLACED, placed.to_dict(), _multiplied, growth, SPEED)


def _multiplied(first: Table, values: Mapping[str, float]) -> dict[str, Any]:
    def times(number: float, name: str) -> float:
        return float(f"{number * values.get(name, 1.0):.6g}")

    gains = {
        joint: {name: times(number, name) for name, number in own.items()} for joint, own in first["gains"].items()
    }
    return {**first, "derivative_time": times(first["derivative_time"], "derivative_time"), "gains": gains}


def lqr_space(spec: PlantSpec, pose: Array) -> SearchSpace:
    """Of the linear quadratic regulator.

    Raises:
        ControllerError: where no regulator keeps the robot where it is.
    """
    return _regulated(LqrSettings(), spec, pose, bounded=True)


def nmpc_space(spec: PlantSpec, pose: Array) -> SearchSpace:
    """Of the predictive controller, as of the regulator behind its horizon."""
    return _regulated(NmpcSettings(), spec, pose)


def _regulated(
    settings: LqrSettings | NmpcSettings | SamplingSettings, spec: PlantSpec, pose: Array, bounded: bool = False
) -> SearchSpace:
    bandwidth = allowances(spec, settings, pose, bounded).bandwidth / (2 * np.pi)
    if not bandwidth:
        return _about(settings, ALLOWED)
    low, high = BANDWIDTH
    ranges = {"bandwidth": Range(low * bandwidth, high * bandwidth, bandwidth)}
    return SearchSpace(ranges, settings.to_dict(), speed={"bandwidth": 1.0})


def sampling_space(spec: PlantSpec, pose: Array) -> SearchSpace:
    """Of the sampling controller, by what plans of the robot are."""
    kind = kind_of(Model(spec.model, spec.effects, spec.phase), pose, "auto")
    settings = SamplingSettings()
    settings = replace(settings, deviation=settings.usual(kind).deviation)
    if kind != FOLLOWS:
        return _about(settings, LOOKED)
    if spec.model.traits.commands_are_pressures:
        return _about(settings, SAMPLED)
    other = _about(settings, FOLLOWED)
    return replace(other, ranges={**_regulated(settings, spec, pose).ranges, **other.ranges}, speed={"bandwidth": 1.0})


def _about(settings: FileSettings, factors: Mapping[str, tuple[float, float]]) -> SearchSpace:
    """Ranges about what settings say."""
    table = settings.to_dict()
    ranges = {}
    for name, (low, high) in factors.items():
        start: Any = table
        for key in name.split("."):
            start = start[key]
        ranges[name] = Range(low * start, high * start, start)
    return SearchSpace(ranges, table)
