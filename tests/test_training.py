"""Training: what is learned, kept and gone on with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from learning_cases import VALVES, leg

pytest.importorskip("gymnasium", reason="Gymnasium is not installed (extra rl)")
torch = pytest.importorskip("torch", reason="torch is not installed (extra rl): a large download, see docs/learning.md")
pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed (extra rl)")
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3  # noqa: E402

from equimus_ctrl import workflow  # noqa: E402
from equimus_ctrl.cli.main import main  # noqa: E402
from equimus_ctrl.errors import ConfigError  # noqa: E402
from equimus_ctrl.learning.policy import Policy  # noqa: E402
from equimus_ctrl.learning.training import Trainer, network_of  # noqa: E402
from equimus_ctrl.options import ALGORITHMS, TrainOptions  # noqa: E402
from equimus_ctrl.workflow import training  # noqa: E402
from equimus_ctrl.workflow.learning import make_env  # noqa: E402

SMALL = {"envs": 4, "robots": 3, "unseen": 2, "randomise": 0.2, "noise": 0.001, "control": 60.0, "threads": 1}
SHORT = {"task_options": {"duration": "0.4"}}
ROUND = 4 * 4 * 24


@pytest.mark.parametrize("kind", [PPO, A2C, SAC, TD3, DDPG], ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("activation", ["Tanh", "ReLU", "ELU"])
def test_the_network_acts_as_torchs(kind: Any, activation: str) -> None:
    env = make_env("kick", control=60.0)
    layers = {"activation_fn": getattr(torch.nn, activation), "net_arch": [24, 16]}
    model = kind("MlpPolicy", env, policy_kwargs=layers, seed=1, device="cpu")
    network = network_of(model.policy)
    seen = np.random.default_rng(0).normal(size=(50, network.inputs)).astype(np.float32)
    wanted, _ = model.predict(seen, deterministic=True)
    assert np.clip(network(seen), -1, 1) == pytest.approx(wanted, abs=2e-6)
    assert np.ptp(wanted) > 1e-3


@pytest.mark.parametrize("algorithm", ["ppo", pytest.param("sac", marks=pytest.mark.slow)])
def test_stopped_and_gone_on_is_never_stopped(algorithm: str, tmp_path: Path) -> None:
    """Three rounds at once, and one, then two: the same bits, but for times."""
    own = {**SMALL, **SHORT, "algorithm": algorithm, "seed": 4}
    if algorithm == "sac":
        own["hyper"] = {"learning_starts": 100, "gradient_steps": 1}
    whole = workflow.train(tmp_path / "whole", "kick", leg(*VALVES), steps=3 * ROUND, **own)
    workflow.train(tmp_path / "parts", "kick", leg(*VALVES), steps=1, **own)
    parts = workflow.train(tmp_path / "parts", "kick", leg(*VALVES), steps=3 * ROUND, **own)
    assert len(whole.curve) == 3 and whole.reason == parts.reason == "steps"
    times = {"seconds": 0, "cpu_seconds": 0}
    for one, other in zip(whole.curve, parts.curve, strict=True):
        assert {**one, **times} == {**other, **times}
    latest = [Policy.from_bytes((tmp_path / name / "checkpoint.zip").read_bytes(), name) for name in ("whole", "parts")]
    for a, b in zip(latest[0].network.weights, latest[1].network.weights, strict=True):
        assert np.array_equal(a, b)
    assert np.array_equal(latest[0].normalisation.mean, latest[1].normalisation.mean)
    assert (
        whole.curve[0]["return"] != whole.curve[2]["return"] or whole.curve[0]["explored"] != whole.curve[2]["explored"]
    )


def test_what_is_stopped_in_a_round_goes_on_before_it(tmp_path: Path) -> None:
    asked = 0

    def stopped() -> bool:
        nonlocal asked
        asked += 1
        return asked > 130  # in the second round of 96 periods each

    own = {**SMALL, **SHORT, "seed": 4}
    first = workflow.train(tmp_path, "kick", leg(), stopped=stopped, steps=3 * ROUND, **own)
    assert first.reason == "stopped" and len(first.curve) == 1
    assert len(workflow.train(tmp_path, "kick", leg(), steps=2 * ROUND, **own).curve) == 2
    with pytest.raises(ConfigError, match="the training was stopped before its first round was over"):
        workflow.train(tmp_path / "none", "kick", leg(), stopped=lambda: True, steps=ROUND, **own)


def test_another_training_does_not_go_on(tmp_path: Path) -> None:
    own = {**SMALL, **SHORT}
    workflow.train(tmp_path, "kick", leg(), steps=1, **own)
    before = (tmp_path / "checkpoint.zip").read_bytes()
    for change, sentence in (({"seed": 5}, "is a training with seed 0, not 5"), ({"noise": 0.1}, "with noise 0.001")):
        with pytest.raises(ConfigError, match=sentence):
            workflow.train(tmp_path, "kick", leg(), steps=1, **{**own, **change})
    with pytest.raises(ConfigError, match="is a training with model_sha256"):
        workflow.train(tmp_path, "kick", leg(*VALVES), steps=1, **own)
    assert (tmp_path / "checkpoint.zip").read_bytes() == before
    assert workflow.train(tmp_path, "kick", leg(), steps=1, force=True, **{**own, "seed": 5}).settings["seed"] == 5


@pytest.mark.slow
def test_it_learns_to_hold(tmp_path: Path) -> None:
    """The first rounds are worse than the best, by far."""
    found = workflow.train(
        tmp_path, "hold", leg(), steps=30_000, envs=8, unseen=1, seed=1, threads=1,
        task_options={"hip": "80", "knee": "40", "duration": "0.6"},
    )  # fmt: skip
    returns = [row["return"] for row in found.curve]
    assert found.best["return"] > 0.8 * max(returns[0], -100) and found.best["return"] > returns[0]


def test_on_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.chdir(tmp_path)
    told = [
        "train",
        "kick",
        "--control",
        "60",
        "--envs",
        "4",
        "--unseen",
        "1",
        "--steps",
        "1",
        "--set",
        "duration=0.3",
        "--seed",
        "2",
        "-o",
        "out",
        "--json",
    ]
    assert main(told) == 0
    said = capsys.readouterr()
    record = json.loads(said.out)
    assert record["schema"] == "equimus-ctrl/training/1" and record["best"]["steps"] == record["curve"][0]["steps"]
    assert record["settings"]["seed"] == 2 and record["joints"] == ["hip", "knee"] and "torch" in record["versions"]
    assert {path.name for path in Path("out").iterdir()} == {
        "policy.zip", "checkpoint.zip", "curve.png", "kick.mp4", "record.json",
    } or Path("out/kick.gif").exists()  # fmt: skip
    assert "mean return" in said.err and "all steps are done" in said.err
    assert main(["run", "hold", "--set", "duration=0.3", "--no-figures", "-c", "out/checkpoint.zip"]) == 0
    capsys.readouterr()
    for more, sentence in (
        ("--hyper gama=1 -o x", "ppo: "),
        ("--algorithm popo", "there is no algorithm 'popo' (known: a2c"),
        ("--set gapp=1", "kick: there is no option 'gapp'; did you mean 'gap'"),
        ("--set gap=far", "--set gap=far: expected a number"),
        ("--set seen=maybe", "--set seen=maybe: expected yes or no"),
        ("--set place=1,2", "--set place=1,2: expected three numbers"),
        ("--randomise 200", "randomise is 2, expected a share"),
        ("--randomise all", "randomise is 'all', expected a share"),
        ("--randomise diagnosis", "randomise is 'diagnosis' without a diagnosis, expected its record"),
    ):
        assert main(["train", "kick", *more.split()]) == 2
        assert sentence in capsys.readouterr().err
    assert main(["train", "kik"]) == 2
    assert "there is no task 'kik'; did you mean 'kick'" in capsys.readouterr().err


def test_a_checkpoint_of_another_algorithm_does_not_fit() -> None:
    episodes = training.episodes_of("kick", 2, leg(), TrainOptions(control=60.0, threads=1), 0)
    one, other = (Trainer(name, episodes, 0, {}) for name in ("ppo", "td3"))
    with pytest.raises(ConfigError, match="the checkpoint does not fit what is trained"):
        other.restore(*one.state())
    assert {"ppo", "td3"} < set(ALGORITHMS)
