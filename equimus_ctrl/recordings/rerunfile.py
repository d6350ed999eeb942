"""rerun's ``.rrd`` files: a trial's columns and predictions as scalars over its time."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from equimus_ctrl.errors import needs
from equimus_ctrl.presets import write_bytes
from equimus_ctrl.recordings.exported import LIBRARY, Exported


def write_rerun(path: Path, trials: Sequence[Exported]) -> None:
    """Write trials, whole or not at all, for rerun to show.

    Raises:
        NotAvailable: where rerun is not installed.
        ConfigError: where it cannot be written.
    """
    rerun = rerun_library()
    with tempfile.TemporaryDirectory() as scratch:
        file = os.path.join(scratch, "trials.rrd")
        stream = rerun.RecordingStream(LIBRARY, recording_id=path.stem, send_properties=False)
        stream.save(file)
        for trial in trials:
            clock = [rerun.TimeColumn("trial_time", duration=trial.recording.time - trial.recording.time[0])]
            for topic, columns, _ in trial.series():
                for name, values in columns.items():
                    scalars = rerun.Scalars.columns(scalars=values)
                    rerun.send_columns(f"{topic}/{name}", clock, scalars, recording=stream)
        stream.flush()
        stream.disconnect()
        write_bytes(path, Path(file).read_bytes())


def rerun_library() -> Any:
    """The library.

    Raises:
        NotAvailable: where it is not installed.
    """
    try:
        import rerun
    except ImportError:
        raise needs("rerun-sdk", "rerun", "writing .rrd files") from None
    return rerun
