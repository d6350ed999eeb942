"""Policies as ONNX files."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from learning_cases import VALVES, arm, leg
from policy_cases import policy_for

import equimus_ctrl as eq
from equimus_ctrl.errors import ConfigError, NotAvailable
from equimus_ctrl.learning.network import ACTIVATIONS
from equimus_ctrl.learning.onnx_policy import ABOUT, NODES, OnnxPolicy, to_onnx
from equimus_ctrl.learning.policy import Policy
from equimus_ctrl.learning.policy_controller import PolicyController
from equimus_ctrl.workflow.learning import make_episodes
from equimus_ctrl.workflow.runs import load_controller, load_scenario, run_scenario

HOLD = {"hip": "80", "knee": "20", "duration": "0.3"}


@pytest.fixture(scope="module")
def policy() -> Policy:
    model = leg(*VALVES)
    return policy_for(make_episodes("hold", 1, model, scenario=HOLD, threads=1), model)


def test_without_the_library_a_sentence_names_the_extra(
    policy: Policy, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for library in ("onnx", "onnxruntime"):
        monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(NotAvailable, match=r"writing ONNX files needs the onnx .*'equimus-ctrl\[onnx\]'"):
        eq.export_policy(tmp_path / "a.onnx", policy)
    with pytest.raises(NotAvailable, match=r"a policy from an ONNX file needs the onnxruntime .*\[onnx\]"):
        OnnxPolicy.from_bytes(b"", "a.onnx")
    assert not list(tmp_path.iterdir())


def with_libraries() -> Any:
    """The library that writes, or skip."""
    pytest.importorskip("onnxruntime", reason="ONNX Runtime is not installed (extra onnx)")
    return pytest.importorskip("onnx", reason="onnx is not installed (extra onnx)")


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_it_acts_as_the_policy_to_rounding(policy: Policy, activation: str) -> None:
    """Also far out, where normalised observations and actions are limited, and for any number of rows."""
    onnx = with_libraries()
    assert set(NODES) == set(ACTIVATIONS)
    own = replace(policy, network=replace(policy.network, activations=(activation, "identity")))
    data = to_onnx(own)
    assert data == to_onnx(own)
    onnx.checker.check_model(onnx.load_from_string(data), full_check=True)
    other = OnnxPolicy.from_bytes(data, "x")
    assert other.suited == own.suited and other.record == own.record
    for scale in (1.0, 100.0):
        seen = scale * np.random.default_rng(1).normal(size=(300, own.network.inputs)).astype(np.float32)
        wanted = own.act(seen)
        assert other.act(seen) == pytest.approx(wanted, abs=2e-5)
        assert other.act(seen[:1]) == pytest.approx(wanted[:1], abs=2e-5)
        assert np.ptp(wanted) > 1 and np.any(np.abs(wanted) == 1)
    with pytest.raises(ConfigError, match="number 1 of what the policy sees is not finite"):
        other.act(np.full((1, own.network.inputs), np.nan))
    with pytest.raises(ConfigError, match=r"observations have shape \(1, 3\)"):
        other.act(np.zeros((1, 3)))


def test_it_is_a_controller(policy: Policy, tmp_path: Path) -> None:
    with_libraries()
    zipped, path = tmp_path / "policy.zip", tmp_path / "policy.onnx"
    zipped.write_bytes(policy.to_bytes())
    assert eq.export_policy(path, zipped) == path
    with pytest.raises(ConfigError, match="is there already"):
        eq.export_policy(path, policy)
    model = leg(*VALVES)
    scenario = load_scenario("hold", model.robot, effects=model.effects, options=HOLD)
    runs = [
        run_scenario("hold", load_controller(str(own), scenario), model=model, options=HOLD).run
        for own in (zipped, path)
    ]
    assert np.ptp(runs[0].command, axis=0).min() > 100.0  # Pa
    assert runs[1].command == pytest.approx(runs[0].command, rel=1e-4, abs=1.0)
    with pytest.raises(ConfigError, match=r"is for nominal_leg, whose joints are hip, knee; .* are shoulder, elbow"):
        run_scenario("hold", load_controller(str(path), scenario), model=arm(), options={"duration": "0.3"})


def changed(data: bytes, change: Callable[[dict[str, Any]], Any]) -> bytes:
    """The file, its metadata changed; None takes it away."""
    onnx = with_libraries()
    model = onnx.load_from_string(data)
    about = json.loads({own.key: own.value for own in model.metadata_props}[ABOUT])
    told = change(about)
    del model.metadata_props[:]
    if told is not None:
        onnx.helper.set_model_props(model, {ABOUT: told if isinstance(told, str) else json.dumps(told)})
    return bytes(model.SerializeToString())


def test_files_that_do_not_fit_are_sentences(policy: Policy) -> None:
    with_libraries()
    data = to_onnx(policy)
    size = policy.network.inputs
    bare = {"epsilon": 1e-8, "clip": 10.0}
    for given, sentence in (
        (b"not one", r"^x\.onnx: is no ONNX file that can be run, or damaged"),
        (data[:-100], r"^x\.onnx: is no ONNX file that can be run, or damaged"),
        (changed(data, lambda own: None), r"^x\.onnx: says nothing of the robot that it is for"),
        (
            changed(data, lambda own: {**own, "normalisation": bare}),
            r"^x\.onnx: does not say how observations are norm",
        ),
        (changed(data, lambda own: {**own, "schema": "y/1"}), r"^x\.onnx: its schema is 'y/1', expected"),
        (changed(data, lambda own: "{"), r"^x\.onnx: is damaged or not as train --export writes it"),
        (changed(data, lambda own: {**own, "for": {}}), r"^x\.onnx: is damaged or not as train --export writes it"),
        (
            changed(data, lambda own: {**own, "normalisation": {**bare, "mean": [0.0], "variance": [1.0]}}),
            rf"^x\.onnx: takes and gives .*{size}\]",
        ),
        (
            changed(data, lambda own: {**own, "for": {**own["for"], "sight": {"kind": "view"}}}),
            r"^x\.onnx: there is no kind of observation 'view'",
        ),
    ):
        with pytest.raises(ConfigError, match=sentence):
            OnnxPolicy.from_bytes(given, "x.onnx")
    hidden = changed(data, lambda own: {**own, "for": {**own["for"], "privileged": True}})
    with pytest.raises(ConfigError, match="sees what no sensor shows"):
        PolicyController(OnnxPolicy.from_bytes(hidden, "x.onnx"))
