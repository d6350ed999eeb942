"""Environment steps a second: many robots in one process beside Gymnasium's vector environments over single ones.

    python benchmarks/environments.py [--envs 64] [--repeats 5] [--robot valves]

The task is the kick at 60 Hz: on the nominal leg, with valves, and with valves, friction and hysteresis. Every way is
timed in turn, over and over, so that other work on the computer disturbs all alike; quartiles are of these turns. The
processor time of one thread tells what two cores would do that nobody else uses.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

import equimus_ctrl as eq
from equimus_ctrl.effects.base import parse

VALVES = ("transport_delay:maa:delay=0.03", "transport_delay:baa:delay=0.03")
LAGS = ("asymmetric_lag:maa:fill=0.05,vent=0.1", "asymmetric_lag:baa:fill=0.05,vent=0.1")
FORCES = ("coulomb_friction:hip:friction=0.03", "hysteresis:maa:size=0.5,width=0.01")

ROBOTS: dict[str, tuple[str, ...]] = {"nominal": (), "valves": (*VALVES, *LAGS), "forces": (*VALVES, *LAGS, *FORCES)}


def model_with(effects: tuple[str, ...]) -> eq.Model:
    return eq.Model(eq.nominal_leg(), tuple(map(parse, effects)))


def steps_a_second(env: Any, n: int, seconds: float, clock: Callable[[], float] = time.perf_counter) -> float:
    """Of an environment that was reset, with random actions drawn before, by a clock."""
    actions = np.random.default_rng(0).uniform(-1, 1, (64, n, 2)).astype(np.float32)
    env.reset(seed=0)
    for action in actions[:4]:
        env.step(action)
    count, begun = 0, clock()
    while (passed := clock() - begun) < seconds:
        env.step(actions[count % len(actions)])
        count += 1
    return count * n / passed


def measured(n: int, repeats: int, seconds: float, effects: tuple[str, ...]) -> dict[str, Any]:
    single = partial(eq.make_env, "kick", model_with(effects), control=60.0, noise=0.002)
    many = partial(eq.make_vec_env, "kick", n, model_with(effects), control=60.0, noise=0.002)
    ways: dict[str, Any] = {
        "one process": many(),
        "one process, one thread": many(threads=1),
        "SyncVectorEnv": SyncVectorEnv([single] * n),
        "AsyncVectorEnv": AsyncVectorEnv([single] * n),
    }
    rates: dict[str, list[float]] = {name: [] for name in ways}
    busy = []
    try:
        for _ in range(repeats):
            busy.append(steps_a_second(ways["one process, one thread"], n, seconds, time.process_time))
            for name, env in ways.items():
                rates[name].append(steps_a_second(env, n, seconds))
    finally:
        ways["AsyncVectorEnv"].close()
    ratios = np.array(rates["one process"]) / np.array(rates["AsyncVectorEnv"])
    return {
        "effects": list(effects),
        "rates": {name: np.percentile(own, [25, 50, 75]).round().tolist() for name, own in rates.items()},
        "most": {name: round(max(own)) for name, own in rates.items()},
        "of a second of one core": np.percentile(busy, [25, 50, 75]).round().tolist(),
        "over AsyncVectorEnv": np.percentile(ratios, [25, 50, 75]).round(2).tolist(),
        "load": os.getloadavg()[0],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=1.0, help="of each turn")
    parser.add_argument("--robot", action="append", choices=ROBOTS, help="all by default")
    chosen = parser.parse_args()
    for name in chosen.robot or ROBOTS:
        found = measured(chosen.envs, chosen.repeats, chosen.seconds, ROBOTS[name])
        print(json.dumps({"robot": name, **found}), flush=True)


if __name__ == "__main__":
    main()
