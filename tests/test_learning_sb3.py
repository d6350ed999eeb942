"""Environments as Stable-Baselines3 takes them."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from learning_cases import VALVES, arm, leg

from equimus_ctrl.workflow import learning

pytest.importorskip("gymnasium", reason="Gymnasium is not installed (extra rl)")
pytest.importorskip("torch", reason="torch is not installed (extra rl): a large download, see docs/learning.md")
sb3 = pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed (extra rl)")
from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.env_checker import check_env  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize  # noqa: E402

LEG = {"model": leg(*VALVES), "control": 60.0, "noise": 0.001, "duration": 0.5, "randomise": 0.2, "robots": 4}


def test_it_has_nothing_to_say() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(learning.make_env("kick", **LEG))
        check_env(learning.make_env("hold", arm(), scenario={"duration": "0.5"}))


def test_many_go_as_each_alone() -> None:
    n = 3
    many = learning.make_sb3_env("kick", n, **LEG)
    apart = DummyVecEnv([lambda: learning.make_env("kick", **LEG)] * n)
    many.seed(5)
    apart.seed(5)
    assert np.array_equal(many.reset(), apart.reset())
    rng, ends = np.random.default_rng(0), 0
    for _ in range(70):
        actions = rng.uniform(-1, 1, (n, 2)).astype(np.float32)
        one, other = many.step(actions), apart.step(actions)
        for ours, theirs in zip(one[:3], other[:3], strict=True):
            assert np.array_equal(ours, theirs)
        for ours, theirs in zip(one[3], other[3], strict=True):
            assert set(ours) == set(theirs)
            assert all(np.array_equal(ours[key], theirs[key]) for key in theirs)
        ends += int(one[2].sum())
    assert ends >= n


@pytest.mark.slow
def test_ppo_learns_on_it() -> None:
    """A short while on two robots, through the usual wrappers; with the same seed the same policy."""

    def trained() -> np.ndarray:
        env = VecNormalize(VecMonitor(learning.make_sb3_env("kick", 2, **LEG)))
        policy = PPO("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=2, seed=3, device="cpu")
        policy.learn(256)
        return policy.policy.state_dict()["action_net.weight"].numpy().copy()

    first = trained()
    assert np.isfinite(first).all() and np.array_equal(first, trained())
