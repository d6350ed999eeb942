"""Episodes as environments of Gymnasium: one robot, or many in one process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.learning.episodes import Episodes
from equimus_ctrl.learning.observing import LIMIT
from equimus_ctrl.learning.rendering import Pictures, Window
from equimus_ctrl.types import Array

RENDER_MODES = ("rgb_array", "human")
ONE = np.array([0])
Observed = NDArray[np.float32]


def _spaces(episodes: Episodes) -> tuple[Any, Any]:
    observed = gymnasium.spaces.Box(-LIMIT, LIMIT, (episodes.size,), np.float32)
    return observed, gymnasium.spaces.Box(-1.0, 1.0, (episodes.action_size,), np.float32)


def _metadata(episodes: Episodes) -> dict[str, Any]:
    return {"render_modes": list(RENDER_MODES), "render_fps": round(episodes.plant.rates.control)}


def check_render_mode(mode: str | None) -> str | None:
    """Raise ConfigError for a render mode that there is not."""
    if mode is not None and mode not in RENDER_MODES:
        raise ConfigError(unknown_name("render mode", mode, RENDER_MODES))
    return mode


class RobotEnv(gymnasium.Env[Observed, Observed]):
    """One robot at a task.

    Args:
        episodes: of one robot.
        render_mode: ``"rgb_array"``, ``"human"``, or None.

    Raises:
        ConfigError: for an unknown render mode.
    """

    def __init__(self, episodes: Episodes, render_mode: str | None = None) -> None:
        self.episodes, self.render_mode = episodes, check_render_mode(render_mode)
        self.metadata = _metadata(episodes)
        self.observation_space, self.action_space = _spaces(episodes)
        self._window: Window | None = None
        self._pictures = Pictures()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Begin an episode; the same seed gives the same robot, start and noise.

        Args:
            seed: of all that is drawn from now on.
            options: ``robot``, which of the robots it is.

        Raises:
            ConfigError: for an unknown option, or a robot that there is not.
        """
        super().reset(seed=seed)
        self.episodes.begin(0, self.np_random, options)
        return self._shown()

    def step(self, action: ArrayLike) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Hold an action (na,) within ±1 for one control period.

        Raises:
            ConfigError: for an action of the wrong shape or not finite, or where an episode has to begin first.
        """
        done = self.episodes.step(ONE, np.asarray(action)[None])
        observed, info = self._shown()
        return observed, float(done.reward[0]), bool(done.terminated[0]), bool(done.truncated[0]), info

    def _shown(self) -> tuple[Observed, dict[str, Any]]:
        if self.render_mode == "human":
            self.render()
        return self.episodes.observation(ONE)[0], {key: own[0].item() for key, own in self.episodes.info(ONE).items()}

    def render(self) -> Any:
        """A picture (height, width, 3) with ``rgb_array``; with ``human`` it is shown in a window.

        Raises:
            NotAvailable: where there is no window to be had.
        """
        if self.render_mode is None:
            raise ConfigError("the environment has no render mode, expected render_mode='rgb_array' or 'human'")
        model, data = self.episodes.plant.seen(0)
        if self.render_mode == "rgb_array":
            return self._pictures(0, model, data)
        if self._window is None or not self._window.shows(model):
            self.close()
            self._window = Window(model)
        self._window.show(data)
        return None

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()
            self._window = None


class RobotVectorEnv(VectorEnv[Observed, Observed, Any]):
    """Many robots at one task, in one process; each goes the way that it would go alone.

    Seeds and infos are as those of Gymnasium's own vector environments: environment i has seed + i.

    Args:
        episodes: of the robots.
        autoreset_mode: when what is over begins anew: with the next step, within the same, or never by itself.
        render_mode: ``"rgb_array"`` or None.

    Raises:
        ConfigError: for an unknown render mode, or a window, which would be one a robot.
    """

    def __init__(
        self,
        episodes: Episodes,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
    ) -> None:
        if check_render_mode(render_mode) == "human":
            raise ConfigError("many robots at once have no window, expected render_mode='rgb_array' or None")
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            known = [mode.value for mode in AutoresetMode]
            raise ConfigError(unknown_name("autoreset mode", str(autoreset_mode), known)) from None
        self.episodes, self.render_mode, self.num_envs = episodes, render_mode, episodes.n
        self.metadata = {**_metadata(episodes), "autoreset_mode": self._mode}
        self.single_observation_space, self.single_action_space = _spaces(episodes)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._rows = np.arange(self.num_envs)
        self._randoms: list[np.random.Generator] = []
        self._over = np.zeros(self.num_envs, dtype=bool)
        self._pictures = Pictures()

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Begin all episodes, or those of the option ``reset_mask`` (n,).

        Raises:
            ConfigError: for an unknown option, a robot that there is not, or seeds of another number.
        """
        given = dict(options or {})
        mask = np.asarray(given.pop("reset_mask", np.ones(self.num_envs, dtype=bool)), dtype=bool)
        seeds = (
            [None if seed is None else seed + i for i in range(self.num_envs)] if not isinstance(seed, list) else seed
        )
        if len(seeds) != self.num_envs or mask.shape != (self.num_envs,):
            raise ConfigError(f"there are {len(seeds)} seeds, a mask of {mask.shape}, expected {self.num_envs} of each")
        if isinstance(seed, int):
            super().reset(seed=seed)
        for i in self._rows[mask]:
            self._seed(int(i), seeds[i])
            self.episodes.begin(int(i), self._randoms[i], given)
        self._over[mask] = False
        return self.episodes.observation(self._rows), self._infos(self._rows[mask])

    def _seed(self, row: int, seed: int | None) -> None:
        while len(self._randoms) < self.num_envs:
            self._randoms.append(seeding.np_random()[0])
        if seed is not None:
            self._randoms[row] = seeding.np_random(seed)[0]

    def step(self, actions: ArrayLike) -> tuple[Observed, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Hold actions (n, na) for one control period, or begin anew what was over.

        Raises:
            ConfigError: for actions of the wrong shape or not finite, or where an episode has to begin first.
        """
        given = np.asarray(actions)
        wanted = (self.num_envs, self.episodes.action_size)
        if given.shape != wanted:
            raise ConfigError(f"actions have shape {given.shape}, expected {wanted}, a row for each environment")
        rewards = np.zeros(self.num_envs)
        terminated, truncated = np.zeros((2, self.num_envs), dtype=bool)
        anew = self._over if self._mode is AutoresetMode.NEXT_STEP else np.zeros(self.num_envs, dtype=bool)
        for i in self._rows[anew]:
            self.episodes.begin(int(i), self._randoms[i])
        going = self._rows[~anew]
        if len(going):
            done = self.episodes.step(going, given[going])
            rewards[going], terminated[going], truncated[going] = done.reward, done.terminated, done.truncated
        self._over = terminated | truncated
        infos = self._infos(self._rows)
        if self._mode is AutoresetMode.SAME_STEP and self._over.any():
            infos |= self._begun_anew(infos)
        return self.episodes.observation(self._rows), rewards, terminated, truncated, infos

    def _begun_anew(self, infos: Mapping[str, Any]) -> dict[str, Any]:
        """What was over begins again; what was seen and known of it at its end."""
        over = self._over.copy()
        last = np.full(self.num_envs, None, dtype=object)
        for i, row in zip(self._rows[over], self.episodes.observation(self._rows[over]), strict=True):
            last[i] = row
        final = {key: np.where(over, values, np.zeros((), values.dtype)) for key, values in infos.items()}
        for i in self._rows[over]:
            self.episodes.begin(int(i), self._randoms[i])
        return {
            **self._infos(self._rows),
            "final_obs": last, "_final_obs": over, "final_info": final, "_final_info": over.copy(),
        }  # fmt: skip

    def _infos(self, rows: NDArray[np.int64]) -> dict[str, Any]:
        whole: dict[str, Any] = {}
        among = np.zeros(self.num_envs, dtype=bool)
        among[rows] = True
        for key, values in self.episodes.info(rows).items():
            whole[key] = np.zeros(self.num_envs, dtype=values.dtype)
            whole[key][rows] = values
            whole[f"_{key}"] = among.copy()
        return whole

    def render(self) -> tuple[Any, ...] | None:
        """A picture of each robot."""
        if self.render_mode is None:
            raise ConfigError("the environment has no render mode, expected render_mode='rgb_array'")
        return tuple(self._pictures(row, *self.episodes.plant.seen(row)) for row in range(self.num_envs))
