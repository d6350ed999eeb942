"""Policies for tests."""

from __future__ import annotations

import itertools

import numpy as np

from equimus_ctrl.learning.episodes import Episodes
from equimus_ctrl.learning.network import Network, Normalisation
from equimus_ctrl.learning.policy import Policy, Suited
from equimus_ctrl.models.model import Model


def policy_for(episodes: Episodes, model: Model, seed: int = 0) -> Policy:
    """One that nobody trained, for what these show."""
    rng = np.random.default_rng(seed)
    sizes = (episodes.size, 16, episodes.action_size)
    weights = tuple(rng.normal(size=(b, a)).astype(np.float32) / 2 for a, b in itertools.pairwise(sizes))
    biases = tuple(rng.normal(size=b).astype(np.float32) / 4 for b in sizes[1:])
    scale = Normalisation(rng.normal(size=sizes[0]) / 5, rng.uniform(0.2, 2, sizes[0]))
    task, own = episodes.task, episodes.settings
    suited = Suited.to(
        episodes.plant.spec, robot=model.name, history=own.history, privileged=own.privileged, task=task.name,
        sight=task.sight, blind=task.blind,
    )  # fmt: skip
    return Policy(Network(weights, biases, ("tanh", "identity")), scale, suited, {"seed": seed})
