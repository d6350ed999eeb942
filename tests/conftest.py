"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.workflow import plugins

# The same examples in every run; `--hypothesis-profile=default` draws new ones.
hypothesis.settings.register_profile("repeatable", derandomize=True)
hypothesis.settings.load_profile("repeatable")


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


@pytest.fixture(autouse=True)
def catalogue() -> Iterator[None]:
    """Effects that a test adds to the catalogue are gone after it."""
    registered, loaded = dict(REGISTRY), dict(plugins._loaded)
    yield
    for known, before in ((REGISTRY, registered), (plugins._loaded, loaded)):
        known.clear()
        known.update(before)
