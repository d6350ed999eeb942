"""Kernels compiled in other processes: they lie in the cache afterwards, and nothing depends on them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from morphologies import random_morphology

from equimus_ctrl.engines import compiled
from equimus_ctrl.engines.ahead import CompiledAhead
from equimus_ctrl.models.model import Model


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("EQUIMUS_CACHE", str(tmp_path))
    return tmp_path


def test_what_was_waited_for_is_in_the_cache(empty_cache: Path) -> None:
    model = Model(random_morphology("one_joint", 0))
    with CompiledAhead([model], 2) as ahead:
        ahead.wait(0)
        kernels = list(empty_cache.glob("equimus_lane_kernel_*.py"))
        code = list((empty_cache / "__pycache__").glob("equimus_lane_kernel_*.nbc"))
    assert len(kernels) == 1
    assert code
    ours = compiled.load_lanes(compiled.structure(model.morphology), "swing", ())
    assert Path(str(ours.__file__)).name == kernels[0].name


def test_a_process_that_fails_holds_nobody_up(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with CompiledAhead([Model(random_morphology("one_joint", s)) for s in range(3)], 2) as ahead:
        for index in (2, 0, 1):
            ahead.wait(index)
    assert not list(empty_cache.glob("equimus_lane_kernel_*"))


def test_nothing_to_compile_is_no_process() -> None:
    with CompiledAhead([], 2) as ahead:
        ahead.wait(0)
