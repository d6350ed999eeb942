"""Options of ``train``."""
# ruff: noqa: RUF009 – options are fields, made as ``dataclasses.field`` makes them

from __future__ import annotations

import ast
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.options.fields import NAMES, at_least, counted, key_values, set_of
from equimus_ctrl.options.offers import option

ALGORITHMS = ("a2c", "ddpg", "ppo", "sac", "td3")
"""Of Stable-Baselines3, by what it calls them, in small letters."""
UNSEEN_SEED = 1_000_000
"""``robot_seed`` of the robots that policies are judged on; none is trained on them."""


def hyper_of(items: Iterable[str]) -> dict[str, Any]:
    """``--hyper`` as a table; what reads as a number, a list or a table is one."""
    return {name: _value(text) for name, text in key_values(items, "--hyper").items()}


def _value(text: str) -> Any:
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def share_of(text: str) -> float | str | None:
    """``--randomise``: a share in per cent, or a word."""
    try:
        return float(text.removesuffix("%")) / 100
    except ValueError:
        return text


@dataclass(frozen=True)
class TrainOptions:
    """How a policy is trained.

    Attributes:
        algorithm: of Stable-Baselines3, see ``ALGORITHMS``.
        steps: of the environments, all together.
        budget: no more than so long [s].
        seed: of everything that is drawn.
        envs: robots that are simulated at once.
        robots: different ones that episodes are on.
        unseen: others that policies are judged on.
        randomise: see ``EnvSettings``.
        diagnosis: its record or the folder with it.
        control: see ``EnvSettings`` [Hz].
        noise: the same [rad or m].
        history: the same.
        task_options: of ``KickSettings`` or of a scenario, as text.
        hyper: arguments of the algorithm.
        threads: of the simulation.

    Raises:
        ConfigError: for a value that cannot be.
    """

    algorithm: str = option("ppo", str, f"Of Stable-Baselines3: {', '.join(ALGORITHMS)}.")
    steps: int = option(2_000_000, int, "Of the environments, all together.")
    budget: float | None = option(None, float | None, "No longer than this, in s.", metavar="SECONDS")
    seed: int = option(0, int, "Of everything that is drawn.")
    envs: int = option(64, int, "Robots that are simulated at once.")
    robots: int = option(64, int, "Different robots that episodes are on, where they differ.")
    unseen: int = option(32, int, "Others that policies are judged on.")
    randomise: float | str | None = option(
        None,
        str | None,
        "How robots differ: diagnosis, or by how many per cent at most; not at all by default.",
        metavar="PERCENT",
        read=share_of,
    )
    diagnosis: Path | None = option(
        None, Path | None, "Record of a diagnosis, or the folder with it, to draw robots from.", metavar="PATH"
    )
    control: float | None = option(None, float | None, "Commands a second; the plant's own by default.")
    noise: float | None = option(None, float | None, "White noise on positions, in rad or m; as diagnosed, else none.")
    history: int = option(3, int, "Measurements and commands so far that are seen.")
    task_options: Mapping[str, str] | None = option(
        None, NAMES, "An option of the task.", "--set", metavar="KEY=VALUE", read=set_of
    )
    hyper: Mapping[str, Any] | None = option(
        None, NAMES, "An argument of the algorithm, such as gamma=0.99.", metavar="KEY=VALUE", read=hyper_of
    )
    threads: int | None = option(None, int | None, "Of the simulations; all cores by default.")

    def __post_init__(self) -> None:
        """Check the values."""
        if self.algorithm not in ALGORITHMS:
            raise ConfigError(unknown_name("algorithm", self.algorithm, ALGORITHMS))
        if self.steps < 1:
            raise ConfigError(f"steps is {self.steps}, expected at least 1")
        if self.budget is not None and not 0 < self.budget < math.inf:
            raise ConfigError(f"the budget is {self.budget:g} s, expected a time above 0")
        if not 0 <= self.seed < UNSEEN_SEED:
            raise ConfigError(f"seed is {self.seed}, expected 0 to {UNSEEN_SEED - 1:,}")
        for name in ("envs", "robots", "unseen", "history"):
            counted(name, getattr(self, name))
        counted("threads", self.threads)
        at_least("noise", self.noise, 0)
