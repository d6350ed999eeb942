"""Real robots and their emulator by file and name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from equimus_ctrl import presets
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.hardware.settings import HardwareSettings

DEFAULT = "equimus_leg.toml"


def load_hardware(path: Path | None, model: Model, domain: int | None = None) -> HardwareSettings:
    """How a robot is reached.

    Args:
        path: of the file; ``hardware/equimus_leg.toml`` by default.
        model: of the robot that it has to fit.
        domain: of DDS, in place of the file's.

    Raises:
        ConfigError: where the file cannot be read, or does not fit the robot.
    """
    chosen = path or presets.find("hardware", DEFAULT)
    if chosen is None:
        raise ConfigError(f"hardware/{DEFAULT} is not there; give a file with --hardware FILE")
    settings = HardwareSettings.from_dict(presets.read_toml(chosen), str(chosen))
    if domain is not None:
        settings = replace(settings, wire=replace(settings.wire, domain=domain))
    m = model.morphology
    settings.for_robot(m.joint_names, m.actuator_names, str(chosen))
    return settings
