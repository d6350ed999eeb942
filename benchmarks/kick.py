"""The kick: what learning reaches beside a burst of two commands found by CMA-ES, and what carries over.

    python benchmarks/kick.py train --seeds 3 4 5 6 7 --budget 600
    python benchmarks/kick.py transfer --diagnosis report --draws 200 nominal=a/policy.zip corrected=b/policy.zip

``train`` trains with each seed on the nominal leg and says when the policy reached 95 % of the burst's ball speed.
``transfer`` judges policies on robots drawn from a diagnosis: success is a ball within 10° of the target at 80 % or
more of the speed that is reachable on that robot: the best of the bursts found on a few of the robots, of others
near these, and of all that is judged. Sampling MPC is not among them: the library's plans joints along a reference and
knows of no ball.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import equimus_ctrl as eq
from equimus_ctrl.learning.burst import Burst, judge_rows, search_burst
from equimus_ctrl.learning.episodes import Episodes
from equimus_ctrl.learning.evaluation import Judged, judge
from equimus_ctrl.learning.kick import AIM
from equimus_ctrl.learning.policy import Policy
from equimus_ctrl.report import style
from equimus_ctrl.workflow.learning import make_episodes

CONTROL, ENOUGH, SHARE = 60.0, 0.95, 0.8
SEARCHED, NEAR, ANCHORS, BETWEEN = 40, 16, 8, 0.15
UNSEEN = 2_000_000


def burst_on(episodes: Episodes, robot: int = 0) -> Burst:
    """The best of a few searches."""
    found = [search_burst(episodes, seed, SEARCHED, np.array([robot])) for seed in range(2)]
    return max(found, key=lambda own: own[1])[0]


def train(arguments: argparse.Namespace) -> dict[str, Any]:
    episodes = make_episodes("kick", 64, control=CONTROL)
    burst = burst_on(episodes)
    plain = float(judge(episodes, burst.act, 0).info["ball_speed"][0])
    rows, curves = [], {}
    for seed in arguments.seeds:
        spent, begun = [], time.process_time()
        found = eq.train(
            arguments.output / f"seed-{seed}", "kick", control=CONTROL, seed=seed, steps=10**9, budget=arguments.budget,
            threads=arguments.threads, progress=lambda *said, spent=spent: spent.append(time.process_time()),
        )  # fmt: skip
        enough = [k for k, row in enumerate(found.curve) if row["ball_speed"] >= ENOUGH * plain]
        first = found.curve[enough[0]] if enough else {"steps": None, "seconds": None}
        rows.append({
            "seed": seed, "ball_speed": found.best["ball_speed"], "share": found.best["ball_speed"] / plain,
            "miss_angle": found.best["miss_angle"], "steps": found.curve[-1]["steps"], "steps_to_95": first["steps"],
            "seconds_to_95": first["seconds"], "cpu_seconds_to_95": spent[enough[0]] - begun if enough else None,
            "seconds": found.curve[-1]["seconds"], "cpu_seconds": spent[-1] - begun,
        })  # fmt: skip
        curves[str(seed)] = [(row["steps"], row["ball_speed"]) for row in found.curve]
        print(rows[-1], flush=True)
    drawn = style.save(curves_figure(curves, plain), arguments.output / "curves.png")
    print(f"wrote {drawn}", flush=True)
    return {"burst": {**burst.to_dict(1 / CONTROL), "ball_speed": plain}, "policies": rows, "curves": curves}


def curves_figure(curves: Mapping[str, Sequence[tuple[int, float]]], plain: float) -> Figure:
    """Ball speed over steps of the environments, for each seed; the burst's, and what is enough."""
    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = figure.subplots()
    for seed, points in curves.items():
        axes.plot([steps / 1e3 for steps, _ in points], [speed for _, speed in points], lw=1.2, label=f"seed {seed}")
    for value, text, drawn in ((plain, "burst", "--"), (ENOUGH * plain, f"{ENOUGH:.0%} of it", ":")):
        axes.axhline(value, color=style.INK, lw=0.8, ls=drawn, label=f"{text}: {value:.2f} m/s")
    axes.set_xlabel("steps of the environments, in thousands")
    axes.set_ylabel("ball speed towards the target [m/s]")
    axes.set_title("Training to kick, on the nominal leg", loc="left")
    axes.legend(loc="lower right", fontsize=8, ncols=2)
    return figure


def reachable(draws: Episodes, anchors: Episodes) -> np.ndarray:
    """(n,) the best speeds towards the target of bursts, on each robot."""
    rng = np.random.default_rng(0)
    best = np.zeros(draws.n)
    for robot in range(min(ANCHORS, draws.n)):
        vector = burst_on(anchors, robot).vector
        for k in range(NEAR + 1):
            near = vector + (k > 0) * BETWEEN * rng.normal(size=len(vector)) * [*(1.0,) * (len(vector) - 1), 10.0]
            near[:-1] = np.clip(near[:-1], -1, 1)
            judge_rows(draws, np.tile(near, (draws.n, 1)), UNSEEN, np.arange(draws.n))
            best = np.maximum(best, hit(draws))
    return best


def hit(draws: Episodes) -> np.ndarray:
    """(n,) speeds towards the target of balls that flew to it, else 0."""
    info = draws.task.info(np.arange(draws.n))
    return np.where(info["miss_angle"] <= AIM, info["ball_speed"], 0.0)


def transfer(arguments: argparse.Namespace) -> dict[str, Any]:
    more = {
        "control": CONTROL, "randomise": "diagnosis", "diagnosis": arguments.diagnosis, "robot_seed": UNSEEN,
        "robots": arguments.draws,
    }  # fmt: skip
    draws, anchors = (make_episodes("kick", n, **more) for n in (arguments.draws, 64))
    best = reachable(draws, anchors)
    nominal = burst_on(make_episodes("kick", 64, control=CONTROL))
    judged: dict[str, Judged] = {"burst, nominal leg": judge(draws, nominal.act, UNSEEN)}
    for text in arguments.policies:
        name, _, path = text.rpartition("=")
        policy = Policy.from_bytes(Path(path).read_bytes(), path)
        judged[name or path] = judge(draws, lambda seen, period, own=policy: own.act(seen), UNSEEN)
    speeds = {
        name: np.where(own.info["miss_angle"] <= AIM, own.info["ball_speed"], 0.0) for name, own in judged.items()
    }
    best = np.max([best, *speeds.values()], axis=0)
    return {
        "draws": arguments.draws, "reachable": np.quantile(best, [0, 0.5, 1]).tolist(),
        "success": {name: float(np.mean(speed >= SHARE * best)) for name, speed in speeds.items()},
        "median_speed": {name: float(np.median(speed)) for name, speed in speeds.items()},
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(required=True)
    one = verbs.add_parser("train")
    one.add_argument("--seeds", type=int, nargs="+", default=[3, 4, 5, 6, 7])
    one.add_argument("--budget", type=float, default=600.0)
    one.add_argument("--threads", type=int, help="of the simulation; all cores by default")
    one.add_argument("--output", type=Path, default=Path("results/kick"))
    one.set_defaults(work=train)
    other = verbs.add_parser("transfer")
    other.add_argument("policies", nargs="*")
    other.add_argument("--diagnosis", type=Path, required=True)
    other.add_argument("--draws", type=int, default=200)
    other.set_defaults(work=transfer)
    arguments = parser.parse_args()
    print(json.dumps(arguments.work(arguments), indent=1))


if __name__ == "__main__":
    main()
