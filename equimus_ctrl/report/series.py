"""A run as a table over time, beside its figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from equimus_ctrl import presets
from equimus_ctrl.types import Run


def save_series(run: Run, path: Path) -> Path:
    """Write a CSV with a row for each control instant, in SI units.

    Columns are ``time``, ``cmd.<actuator>`` as applied, ``pos.<joint>`` as measured, ``ref.<joint>``, ``true.<joint>``
    where the plant knows them, and ``asked.<actuator>`` as the controller had it.

    Raises:
        ConfigError: where it cannot be written.
    """
    joints, actuators = run.spec.joints, run.spec.actuators
    parts = [("cmd", actuators, run.command), ("pos", joints, run.position), ("ref", joints, run.reference)]
    if run.truth is not None:
        parts.append(("true", joints, run.truth))
    parts.append(("asked", actuators, run.asked))
    header = ["time", *(f"{kind}.{name}" for kind, names, _ in parts for name in names)]
    rows = np.column_stack([run.time, *(values for *_, values in parts)])
    lines = [",".join(f"{value:.9g}" for value in row) for row in rows.tolist()]
    presets.write_text(path, "\n".join([",".join(header), *lines]) + "\n")
    return path
