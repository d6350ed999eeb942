"""Recordings: reading, writing, checking, importing, fetching and finding them.

The only part of the library that knows file formats. What it hands on is ``equimus_ctrl.types.Recording``.
"""

from __future__ import annotations

from equimus_ctrl.recordings.checks import LEG, Limits, RecordingWarning
from equimus_ctrl.recordings.commands import CommandFile, read_commands, write_commands
from equimus_ctrl.recordings.csvfile import read, write
from equimus_ctrl.recordings.download import Fetched, fetch
from equimus_ctrl.recordings.exported import Exported, Prediction
from equimus_ctrl.recordings.formats import WRITERS, write_recording
from equimus_ctrl.recordings.locate import fetch_folder, find_recordings, leg_file, missing_hint
from equimus_ctrl.recordings.logs import Wanted
from equimus_ctrl.recordings.mapping import Mapping, read_mapping
from equimus_ctrl.recordings.paths import read_path
from equimus_ctrl.recordings.sets import Summary, convert, read_set, summarise, write_set
from equimus_ctrl.recordings.upstream import StaticPoses, read_static_poses

__all__ = [
    "LEG",
    "WRITERS",
    "CommandFile",
    "Exported",
    "Fetched",
    "Limits",
    "Mapping",
    "Prediction",
    "RecordingWarning",
    "StaticPoses",
    "Summary",
    "Wanted",
    "convert",
    "fetch",
    "fetch_folder",
    "find_recordings",
    "leg_file",
    "missing_hint",
    "read",
    "read_commands",
    "read_mapping",
    "read_path",
    "read_set",
    "read_static_poses",
    "summarise",
    "write",
    "write_commands",
    "write_recording",
    "write_set",
]
