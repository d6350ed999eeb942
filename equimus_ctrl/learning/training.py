"""Training in rounds, with algorithms of Stable-Baselines3.

Each round begins its episodes and its random streams anew, from the seed and its number alone. What is kept between
rounds is what has been learned: parameters, the optimiser's moments, normalisation, replay buffer, counts. So a run
that is stopped between rounds and goes on does what one does that was never stopped, bit for bit on one computer.
"""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from equimus_ctrl.errors import FAILURES, ConfigError
from equimus_ctrl.learning.episodes import Episodes
from equimus_ctrl.learning.network import Network, Normalisation
from equimus_ctrl.learning.policy import Policy, Suited
from equimus_ctrl.learning.sb3 import RobotVecEnv
from equimus_ctrl.types import Array

EPISODES = 4
"""Of each robot in a round."""
LONGEST = 128
"""Control periods of an episode that count for that, at most."""
BATCHES = 4
"""Parts of what an on-policy algorithm gathered that take a gradient step each, at most."""
SETTLES = {"Tanh": "tanh", "ReLU": "relu", "ELU": "elu", "LeakyReLU": "leaky_relu", "Identity": "identity"}
"""What torch calls the activations."""
COUNTS = ("num_timesteps", "_n_updates", "_episode_num")


def defaults(algorithm: str, envs: int, periods: int, finite: bool) -> dict[str, Any]:
    """Arguments of an algorithm that suit episodes of so many control periods, all beside each other in a process.

    Of a task that is over at a known time, as a kick is, the whole return counts, undiscounted: what comes of a
    backswing comes late. Such a task has local optima, a kick without one among them, so PPO begins with commands all
    over the range, keeps some of that (entropy), and sees several whole episodes of each robot before it learns.
    """
    if algorithm not in ("ppo", "a2c"):
        return {"learning_starts": 20 * envs, "gradient_steps": max(envs // 4, 1), "buffer_size": 200_000}
    steps = EPISODES * periods if finite else min(periods, LONGEST)
    if algorithm == "a2c":
        return {"n_steps": min(steps, 16)}
    whole = steps * envs
    parts = next(k for k in range(BATCHES, 0, -1) if whole % k == 0)
    own: dict[str, Any] = {"n_steps": steps, "batch_size": whole // parts}
    if not finite:
        return own
    return own | {
        "n_epochs": 5, "learning_rate": 1e-3, "gamma": 1.0, "gae_lambda": 1.0, "ent_coef": 0.01,
        "policy_kwargs": {"log_std_init": 0.7},
    }  # fmt: skip


class _Stop(BaseCallback):
    def __init__(self, stopped: Callable[[], bool]) -> None:
        super().__init__()
        self._stopped, self.done = stopped, False

    def _on_step(self) -> bool:
        self.done = self._stopped()
        return not self.done


class Trainer:
    """What learns.

    Args:
        algorithm: of Stable-Baselines3, in small letters.
        episodes: that it learns on.
        seed: of all that is drawn.
        hyper: arguments of the algorithm beside ``defaults``.
        board: folder for TensorBoard; none where it is not installed.

    Raises:
        ConfigError: for arguments that the algorithm does not take.
    """

    def __init__(
        self, algorithm: str, episodes: Episodes, seed: int, hyper: Mapping[str, Any], board: Path | None = None
    ) -> None:
        kind = getattr(stable_baselines3, algorithm.upper())
        self.arguments = {**defaults(algorithm, episodes.n, episodes.periods, episodes.task.finite), **hyper}
        self._episodes, self._seed, self._algorithm = episodes, seed, algorithm
        gamma = float(self.arguments.get("gamma", 0.99))
        self._scaled = VecNormalize(VecMonitor(RobotVecEnv(episodes)), norm_reward=True, gamma=gamma)
        with _one_thread():
            try:
                self.model = kind("MlpPolicy", self._scaled, seed=seed, device="cpu", **self.arguments)
            except FAILURES as error:
                raise ConfigError(f"{algorithm}: {error}; it was given {self.arguments}") from None
        written = board is not None and importlib.util.find_spec("tensorboard") is not None
        self.model.set_logger(configure(str(board) if written else None, ["tensorboard"] if written else []))
        least = EPISODES * min(episodes.periods, LONGEST)
        gathered = int(getattr(self.model, "n_steps", 1))  # of each robot before an on-policy algorithm learns
        self._steps = episodes.n * gathered * -(-least // gathered)

    @property
    def steps(self) -> int:
        """Of the environments so far."""
        return int(self.model.num_timesteps)

    def round(self, number: int, stopped: Callable[[], bool]) -> bool:
        """Learn in one round; whether it came to its end.

        Args:
            number: from 0.
            stopped: asked after each step; then nothing of the round counts.
        """
        seed = int(np.random.SeedSequence([self._seed, number]).generate_state(1)[0] >> 2)
        stop = _Stop(stopped)
        with _one_thread():
            set_random_seed(seed)
            self._scaled.seed(seed)
            self.model.action_space.seed(seed)
            self.model._last_obs = self.model.ep_info_buffer = None
            try:
                self.model.learn(self._steps, callback=stop, reset_num_timesteps=False, log_interval=1)
            except ValueError as error:
                raise ConfigError(
                    f"{self._algorithm} lost its numbers after {self.steps:,} steps ({str(error).splitlines()[0]}); "
                    "expected a smaller learning_rate"
                ) from None
        return not stop.done

    def said(self) -> float:
        """Mean return of the latest episodes of the round, explored; nan before any has ended."""
        ended = self.model.ep_info_buffer or ()
        return float(np.mean([own["r"] for own in ended])) if ended else float("nan")

    def state(self) -> tuple[bytes, dict[str, Array]]:
        """What is to be kept between rounds."""
        buffer = io.BytesIO()
        loose = {name: recursive_getattr(self.model, name).detach() for name in self._loose()}
        torch.save({"parameters": self.model.get_parameters(), "loose": loose}, buffer)
        arrays = {f"count.{name}": np.array(getattr(self.model, name)) for name in COUNTS if hasattr(self.model, name)}
        for name, own in (("observations", self._scaled.obs_rms), ("returns", self._scaled.ret_rms)):
            arrays |= {f"{name}.{key}": np.array(getattr(own, key)) for key in ("mean", "var", "count")}
        if (replay := getattr(self.model, "replay_buffer", None)) is not None:
            kept = {key: value for key, value in vars(replay).items() if isinstance(value, np.ndarray)}
            filled = replay.buffer_size if replay.full else replay.pos
            arrays |= {f"replay.{key}": value[:filled] for key, value in kept.items()}
            arrays |= {"replay_at.pos": np.array(replay.pos), "replay_at.full": np.array(replay.full)}
        return buffer.getvalue(), arrays

    def restore(self, state: bytes, arrays: Mapping[str, Array]) -> None:
        """Go on from what was kept.

        Raises:
            ConfigError: where it is another algorithm's, or of other settings.
        """
        try:
            # Tensors and numbers alone: nothing that a file could have run.
            held = torch.load(io.BytesIO(state), weights_only=True)
            self.model.set_parameters(held["parameters"])
            for name in self._loose():
                recursive_getattr(self.model, name).data.copy_(held["loose"][name])
            for name in COUNTS:
                if f"count.{name}" in arrays:
                    setattr(self.model, name, int(arrays[f"count.{name}"]))
            for name, own in (("observations", self._scaled.obs_rms), ("returns", self._scaled.ret_rms)):
                for key in ("mean", "var", "count"):
                    value = arrays[f"{name}.{key}"]
                    setattr(own, key, float(value) if key == "count" else value.copy())
            replay = getattr(self.model, "replay_buffer", None)
            for key, value in arrays.items():
                what, _, name = key.partition(".")
                if what == "replay":
                    getattr(replay, name)[: len(value)] = value
                elif what == "replay_at":
                    setattr(replay, name, value.item())
        except FAILURES as error:
            raise ConfigError(f"the checkpoint does not fit what is trained ({error})") from None

    def _loose(self) -> list[str]:
        """Names of tensors that are learned beside the networks, such as a temperature."""
        return list(self.model._get_torch_save_params()[1])

    def policy(self, suited: Suited) -> Policy:
        """What has been learned so far, without exploring."""
        seen: Any = self._scaled.obs_rms
        scale = Normalisation(
            np.array(seen.mean), np.array(seen.var), float(self._scaled.epsilon), float(self._scaled.clip_obs)
        )
        return Policy(network_of(self.model.policy), scale, suited)


def network_of(policy: Any) -> Network:
    """The layers from observations to the action that an algorithm's policy takes without exploring.

    Raises:
        ConfigError: where it is more than layers of linear maps.
    """
    if hasattr(policy, "mlp_extractor"):
        modules, squashed = [*policy.mlp_extractor.policy_net, policy.action_net], policy.squash_output
        features = policy.features_extractor
    else:
        actor = policy.actor
        features, latent = actor.features_extractor, hasattr(actor, "latent_pi")
        modules, squashed = ([*actor.latent_pi, actor.mu], True) if latent else (list(actor.mu), False)
        if latent and isinstance(actor.mu, torch.nn.Sequential):
            modules = [*actor.latent_pi, *actor.mu]
    if not isinstance(features, FlattenExtractor):
        raise ConfigError("the policy sees through more than its own layers, expected one of linear layers alone")
    weights, biases, names = [], [], []
    for module in (*modules, *((torch.nn.Tanh(),) if squashed else ())):
        kind = type(module).__name__
        if isinstance(module, torch.nn.Linear):
            weights.append(module.weight.detach().numpy().copy())
            biases.append(module.bias.detach().numpy().copy())
            names.append("identity")
        elif kind in SETTLES and names and names[-1] == "identity":
            names[-1] = SETTLES[kind]
        else:
            raise ConfigError(f"the policy has a layer {kind}, expected linear ones and {', '.join(SETTLES)}")
    return Network(tuple(weights), tuple(biases), tuple(names))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Sums are of one order, and small networks no slower."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
