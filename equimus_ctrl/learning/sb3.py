"""Many robots as a vector environment of Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.learning.environments import RobotVectorEnv
from equimus_ctrl.learning.episodes import Episodes


class RobotVecEnv(VecEnv):
    """``RobotVectorEnv`` as Stable-Baselines3 takes it: what is over begins anew within the step.

    Args:
        episodes: of the robots.
        render_mode: ``"rgb_array"`` or None.
    """

    def __init__(self, episodes: Episodes, render_mode: str | None = None) -> None:
        self.inner = RobotVectorEnv(episodes, AutoresetMode.SAME_STEP, render_mode)
        self.metadata = self.inner.metadata
        self._given: NDArray[np.float32] | None = None
        super().__init__(episodes.n, self.inner.single_observation_space, self.inner.single_action_space)

    def reset(self) -> NDArray[np.float32]:
        """Begin all episodes, with the seeds that ``seed`` was told."""
        seeds = list(self._seeds)
        observed, infos = self.inner.reset(seed=seeds if any(seed is not None for seed in seeds) else None)
        self.reset_infos = [self._info(infos, i) for i in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observed

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take note of actions."""
        self._given = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """As of any ``VecEnv``."""
        if self._given is None:
            raise ConfigError("the environments wait for actions that nobody gave, expected step_async before")
        observed, rewards, terminated, truncated, infos = self.inner.step(self._given)
        self._given = None
        done = terminated | truncated
        told = []
        for i in range(self.num_envs):
            own = self._info(infos["final_info"] if done[i] else infos, i)
            if done[i]:
                own["terminal_observation"] = infos["final_obs"][i]
            own["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
            told.append(own)
        return observed, rewards.astype(np.float32), done, told

    def _info(self, infos: dict[str, Any], i: int) -> dict[str, Any]:
        return {key: infos[key][i].item() for key in infos if f"_{key}" in infos and "final" not in key}

    def close(self) -> None:
        """Close it."""
        self.inner.close()

    def get_images(self) -> Sequence[Any]:
        """A picture of each robot."""
        return self.inner.render() or ()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute, the same of all."""
        return [getattr(self.inner, attr_name)] * len(list(self._indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Nothing of single environments can be set."""
        raise ConfigError(f"{attr_name} cannot be set of environments that share one process")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Single environments have no methods."""
        raise ConfigError(f"{method_name} cannot be called of environments that share one process")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """None is."""
        return [False for _ in self._indices(indices)]

    def _indices(self, indices: Any) -> Iterable[int]:
        return self._get_indices(indices)
