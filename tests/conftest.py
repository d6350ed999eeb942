"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def recordings_dir() -> Path:
    """The folder of real recordings: EQUIMUS_RECORDINGS, or ../shared/recordings beside the checkout."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "recordings"
    folder = Path(os.environ.get("EQUIMUS_RECORDINGS") or beside)
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}; EQUIMUS_RECORDINGS can name a folder that has them")
    return folder


@pytest.fixture(scope="session")
def leg_dir(recordings_dir: Path) -> Path:
    """The folder with the recordings of the real leg."""
    for folder in (recordings_dir, recordings_dir / "equimus_leg"):
        if (folder / "triangle.csv").is_file():
            return folder
    pytest.skip(f"no recordings of the leg (triangle.csv) in {recordings_dir}")
