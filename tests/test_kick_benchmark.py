"""The kick's benchmark: files of others."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="Gymnasium is not installed (extra rl)")
pytest.importorskip("torch", reason="torch is not installed (extra rl): a large download, see docs/learning.md")
stable = pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed (extra rl)")

ROOT = Path(__file__).resolve().parents[1]
SCENE = """
<mujoco><option timestep="0.0016667"/><worldbody>
  <body pos="0 0 0.5"><joint name="hip" axis="1 0 0"/><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".1"/>
    <body pos="0 0 -.2"><joint name="knee" axis="1 0 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".1"/></body></body>
  <body name="ball" pos="0 -.1 .1"><freejoint/><geom type="sphere" size=".05" mass=".1"/></body>
  <geom type="plane" size="1 1 .1" pos="0 0 .05"/>
</worldbody><actuator>
  <motor joint="hip" gear="-.01"/><motor joint="hip" gear="-.01"/><motor joint="knee" gear=".01"/>
  <motor joint="knee" gear=".01"/>
</actuator></mujoco>
"""


def saved(path: Path, size: int = 10) -> Any:
    """A policy as the published environment's training would have saved it."""
    box = gymnasium.spaces.Box

    class Shapes(gymnasium.Env):  # type: ignore[misc,name-defined]
        observation_space = box(-np.inf, np.inf, (size,), np.float64)
        action_space = box(-50, 50, (2,), np.float64)

    model = stable.PPO("MlpPolicy", Shapes(), seed=3, device="cpu", policy_kwargs={"log_std_init": 0.0})
    model.policy.action_net.weight.data *= 1e4
    model.save(path)
    return model


def test_published_policies_are_read_and_scored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    own = runpy.run_path(str(ROOT / "benchmarks" / "kick.py"))
    model = saved(tmp_path / "ppo_kick_model_1.zip")
    seen = np.random.default_rng(0).normal(size=(20, 10))
    network = own["published_network"](tmp_path / "ppo_kick_model_1.zip")
    wanted = model.predict(seen, deterministic=True)[0]
    assert np.clip(network(seen.astype(np.float32)), -50, 50) == pytest.approx(wanted, rel=1e-4, abs=1e-3)
    (tmp_path / "scene.xml").write_text(SCENE)
    told = ["kick.py", "published", "--scene", str(tmp_path / "scene.xml"), str(tmp_path / "ppo_kick_model_1.zip")]
    monkeypatch.setattr(sys, "argv", told)
    own["main"]()
    row = json.loads(capsys.readouterr().out)["ppo_kick_model_1.zip"]
    assert 0.05 < row["ball_speed"] < 10 and row["miss_angle"] < 45


def test_what_does_not_fit_is_a_sentence(tmp_path: Path) -> None:
    read = runpy.run_path(str(ROOT / "benchmarks" / "kick.py"))["published_network"]
    saved(tmp_path / "other.zip", 7)
    with pytest.raises(SystemExit, match=r"other\.zip: takes 7 numbers and gives 2, expected 10 and 2: two positions"):
        read(tmp_path / "other.zip")
    (tmp_path / "no.zip").write_bytes(b"no archive")
    with pytest.raises(SystemExit, match=r"no\.zip: is no policy of Stable-Baselines3's PPO"):
        read(tmp_path / "no.zip")
