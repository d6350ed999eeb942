"""A run as a table over time, beside its figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from equimus_ctrl import presets
from equimus_ctrl.types import Run


def save_series(run: Run, path: Path) -> Path:
    """Write a CSV with a row for each control instant, in SI units.

    Columns are those of ``Run.columns``.

    Raises:
        ConfigError: where it cannot be written.
    """
    rows = np.column_stack(list(run.columns.values()))
    lines = [",".join(f"{value:.9g}" for value in row) for row in rows.tolist()]
    presets.write_text(path, "\n".join([",".join(run.columns), *lines]) + "\n")
    return path
