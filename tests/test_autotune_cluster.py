"""Tuning with candidates that are tried by the workers of a Dask cluster: the bits of one computer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from equimus_ctrl import workflow
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.options import AutotuneOptions

PLUGIN = Path(__file__).resolve().parents[1] / "docs" / "examples" / "plugin.py"


def test_one_place_is_said() -> None:
    with pytest.raises(ConfigError, match="--workers and --scheduler are given, expected one"):
        AutotuneOptions(workers=2, scheduler="tcp://head:8786")


@pytest.mark.slow
@pytest.mark.parametrize(
    "controller",
    [
        pytest.param("pid", id="in a compiled loop"),
        pytest.param("leaning", id="of a plugin, on the plant", marks=pytest.mark.long),
    ],
)
def test_a_cluster_gives_the_same_settings_to_the_bit(controller: str, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    options: dict[str, Any] = {"candidates": 6, "scenarios": ["hold"]}
    if controller == "leaning":
        workflow.load_plugins([PLUGIN])

    def tuned(name: str, **where: Any) -> Path:
        folder = tmp_path / name
        workflow.tune_into(controller, folder=folder, output=folder / "tuned.toml", **options, **where)
        return folder

    own = distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0")
    with own:
        there = tuned("there", scheduler=own.scheduler_address)
    here = tuned("here", workers=2)
    for name in ("tuned.toml", "journal.jsonl"):
        assert (there / name).read_bytes() == (here / name).read_bytes()
    assert json.loads((there / "record.json").read_text()) == json.loads((here / "record.json").read_text())
