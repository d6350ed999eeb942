"""Without the extra for learning."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from learning_cases import leg

from equimus_ctrl.errors import NotAvailable
from equimus_ctrl.learning.registration import register_environments
from equimus_ctrl.workflow import learning
from equimus_ctrl.workflow.training import train


def test_a_sentence_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.setitem(sys.modules, "gymnasium.envs", None)
    register_environments()  # nothing to make known
    for make in (learning.make_env, learning.make_vec_env, learning.make_sb3_env):
        with pytest.raises(NotAvailable, match=r"gymnasium library.*pip install 'equimus-ctrl\[rl\]'"):
            make("kick")
    with pytest.raises(NotAvailable, match=r"training needs .*pip install 'equimus-ctrl\[rl\]'"):
        train(tmp_path, "kick")
    assert not list(tmp_path.iterdir())


def test_episodes_need_neither() -> None:
    """So a policy can be judged where nothing is trained."""
    episodes = learning.make_episodes("kick", 2, leg(), control=60.0, threads=1)
    for row in range(2):
        episodes.begin(row, np.random.default_rng(row))
    rows = np.arange(2)
    done = episodes.step(rows, np.zeros((2, 2)))
    assert done.reward.shape == (2,) and episodes.observation(rows).shape == (2, episodes.size)
