"""The kick: what learning reaches beside a burst of two commands found by CMA-ES, and what carries over.

    python benchmarks/kick.py train --seeds 3 4 5 6 7
    python benchmarks/kick.py mpc
    python benchmarks/kick.py published --scene dog2_4singleLeg_realconstrast_kickball.xml ppo_kick_model_*.zip
    python benchmarks/kick.py transfer --diagnosis report --draws 200

``train`` trains with each seed on the nominal leg and says when the policy reached 95 % of the burst's ball speed.
``mpc`` plans anew all the time on that leg, knowing it exactly, by the methods of sampling MPC that the library has.

``transfer`` trains on the nominal leg, on that ± 20 %, on the augmented model of a diagnosis, and on what the diagnosis
leaves open, with as many steps each, and judges on robots drawn from the diagnosis that no policy was trained on, the
ball in the same place for all. Success is a ball within 10° of the target at 80 % or more of the speed that is
reachable on that robot: the best of the bursts that CMA-ES finds on it, and of all that is judged.

``published`` scores the EquiMus authors' policies in their own scene, files that this repository does not hold.

``train`` and ``transfer`` go on where they were stopped.
"""

from __future__ import annotations

import argparse
import io
import json
import pickle
import re
import time
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cmaes
import mujoco
import numpy as np
from matplotlib.figure import Figure

import equimus_ctrl as eq
from equimus_ctrl.learning.burst import POPULATION, Burst, judge_rows, search_burst
from equimus_ctrl.learning.episodes import Episodes
from equimus_ctrl.learning.evaluation import Act, Judged, judge
from equimus_ctrl.learning.kick import AIM, Kick, KickScore
from equimus_ctrl.learning.network import Network
from equimus_ctrl.learning.policy import Policy
from equimus_ctrl.learning.settings import DIAGNOSIS, KickSettings
from equimus_ctrl.predictive.sampling import METHODS, Spread
from equimus_ctrl.report import style
from equimus_ctrl.workflow.learning import make_episodes

CONTROL, ENOUGH, SHARE = 60.0, 0.95, 0.8
SEARCHED, ANCHORS = 40, 2
"""Generations of a search for a burst, and on how many of the robots it begins anew."""
NEAR, REFINED = 0.15, 12
"""Step [of the range] and generations of the search that goes on from there on each robot."""
EXPLORED = {"use_sde": True, "sde_sample_freq": 8, "policy_kwargs": {"log_std_init": 0.0}}
"""What is tried in training lasts for some periods: slow valves do not pass on what is another in each."""
SPENT = ("steps", "seconds", "cpu_seconds")
NOISE = 0.002
"""On measured positions, where no diagnosis says how much [rad]."""
ROLLED, KNOTS, EVERY = 64, 10, 3
"""Of sampling MPC: plans tried at once, knots of a plan over the episode, control periods from plan to plan."""
SPREAD = Spread(least=0.05, most=0.5, temperature=0.1, elites=0.1)
"""The same, of actions within ±1."""
THEIR_SIZES, THEIR_RANGE, THEIR_STEPS, THEIR_TARGET = (10, 2), (0.0, 50.0), 10, np.array([0.0, -1.0, 0.0])
"""Of the published environment: numbers seen and given, pressures that the valves have [kPa], physics steps a command,
and the way to the target. It lets commands go to ±50 kPa; here they stay within what there is."""
LAYER = re.compile(r"mlp_extractor\.policy_net\.\d+\.weight")
QUANTILES = (0.0, 0.05, 0.5, 1.0)
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
        found = eq.train(
            arguments.output / f"seed-{seed}", "kick", control=CONTROL, seed=seed, steps=arguments.steps,
            threads=arguments.threads,
        )  # fmt: skip
        enough = [row for row in found.curve if row["ball_speed"] >= ENOUGH * plain]
        first, last = (enough or [None])[0], found.curve[-1]
        rows.append({
            "seed": seed, "ball_speed": found.best["ball_speed"], "share": found.best["ball_speed"] / plain,
            "miss_angle": found.best["miss_angle"], "whole": {key: last[key] for key in SPENT},
            "to_95_percent": first and {key: first[key] for key in SPENT},
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


@dataclass(frozen=True)
class Way:
    """A way of training: on which robots.

    Attributes:
        corrected: whether the model is the augmented one that the diagnosis gave.
        more: options of ``eq.train`` beside those that all ways share.
    """

    corrected: bool
    more: Mapping[str, Any]


WAYS = {
    "nominal": Way(False, {"noise": NOISE}),
    "nominal ± 20 %": Way(False, {"noise": NOISE, "randomise": 0.2}),
    "corrected": Way(True, {"noise": NOISE}),
    "diagnosis": Way(False, {"randomise": DIAGNOSIS}),
}
"""The last draws robots and noise from what the diagnosis leaves open."""


def transfer(arguments: argparse.Namespace) -> dict[str, Any]:
    folder, diagnosis = arguments.output, arguments.diagnosis
    # Before the foot of the leg as it is: whoever lays the ball down sees that leg.
    place = Kick(eq.load_model(diagnosis / "corrected.toml"), KickSettings()).place.tolist()
    trained = {}
    for name in arguments.ways:
        way = WAYS[name]
        model = diagnosis / "corrected.toml" if way.corrected else None
        more = {"diagnosis": diagnosis, **way.more} if way.more.get("randomise") == DIAGNOSIS else way.more
        found = eq.train(
            folder / f"{name.replace(' ', '')}-{arguments.seed}", "kick", model, control=CONTROL, seed=arguments.seed,
            steps=arguments.steps, history=arguments.history, robots=arguments.robots, threads=arguments.threads,
            task_options={"place": ",".join(map(repr, place))}, hyper=EXPLORED, **more,
        )  # fmt: skip
        row = {key: found.best[key] for key in ("ball_speed", "success", "steps")}
        print(f"{name}: {row}, {found.curve[-1]['seconds']:.0f} s", flush=True)
        trained[name] = found.policy
    real = {
        "control": CONTROL, "randomise": DIAGNOSIS, "diagnosis": diagnosis, "robot_seed": UNSEEN, "place": tuple(place),
        "robots": arguments.draws, "threads": arguments.threads,
    }  # fmt: skip
    nominal = burst_on(make_episodes("kick", 64, control=CONTROL, place=tuple(place), threads=arguments.threads))
    kept = folder / f"reachable-{arguments.draws}.json"
    if not kept.exists():
        found_best = reachable(arguments.draws, nominal, real)
        kept.write_text(json.dumps(found_best.tolist()), encoding="utf-8")
    best = np.array(json.loads(kept.read_text(encoding="utf-8")))
    told: dict[str, Judged] = {}
    acts: dict[str, Act] = {"burst, nominal leg": nominal.act}
    acts |= {name: acting(policy) for name, policy in trained.items()}
    for name, act in acts.items():
        history = trained[name].suited.history if name in trained else 1
        told[name] = judge(make_episodes("kick", arguments.draws, history=history, **real), act, UNSEEN)
    speeds = {name: hits(own.info) for name, own in told.items()}
    best = np.max([best, *speeds.values()], axis=0)
    return {
        "draws": arguments.draws, "reachable": np.quantile(best, QUANTILES).tolist(),
        "success": {name: float(np.mean(speed >= SHARE * best)) for name, speed in speeds.items()},
        "hit": {name: float(np.mean(speed > 0)) for name, speed in speeds.items()},
        "share": {name: np.quantile(speed / best, QUANTILES).tolist() for name, speed in speeds.items()},
    }  # fmt: skip


def acting(policy: Policy) -> Act:
    """As what is judged."""
    return lambda seen, period: policy.act(seen)


def hits(info: Mapping[str, np.ndarray]) -> np.ndarray:
    """(n,) speeds towards the target of balls that flew to it, else 0 [m/s]."""
    return np.where(info["miss_angle"] <= AIM, info["ball_speed"], 0.0)


def reachable(draws: int, nominal: Burst, real: Mapping[str, Any]) -> np.ndarray:
    """(draws,) the best ball speed that a burst reaches on each robot.

    On each, CMA-ES goes on from the burst that does best there, of the nominal leg's and those found on a few others.
    """
    few = make_episodes("kick", 64, **real)
    starts = [nominal.vector, *(search_burst(few, 0, SEARCHED, np.array([k]))[0].vector for k in range(ANCHORS))]
    many = make_episodes("kick", draws * POPULATION, **real)
    robots = np.repeat(np.arange(draws), POPULATION)
    scale = np.array([*(1.0,) * (len(starts[0]) - 1), float(many.periods)])
    tried = np.array([
        judge_rows(many, np.tile(start, (len(robots), 1)), UNSEEN, robots)[::POPULATION] for start in starts
    ])  # fmt: skip
    bounds = np.tile([-1.0, 1.0], (len(scale), 1))
    bounds[-1, 0] = 0.0
    searches = [
        cmaes.CMA(starts[k] / scale, NEAR, bounds=bounds, seed=robot, population_size=POPULATION)
        for robot, k in enumerate(tried.argmax(axis=0))
    ]
    best = np.zeros(draws)
    for _ in range(REFINED):
        asked = np.array([search.ask() for search in searches for _ in range(POPULATION)])
        returns = judge_rows(many, asked * scale, UNSEEN, robots)
        speeds = hits(many.task.info(np.arange(len(robots)))).reshape(draws, POPULATION)
        best = np.maximum(best, speeds.max(axis=1))
        for robot, search in enumerate(searches):
            part = slice(robot * POPULATION, (robot + 1) * POPULATION)
            search.tell([(one, -float(value)) for one, value in zip(asked[part], returns[part], strict=True)])
    return best


def plan(arguments: argparse.Namespace) -> dict[str, Any]:
    """Sampling MPC, knowing the nominal leg and its state exactly: what is left of the episode is planned anew."""
    episodes = make_episodes("kick", ROLLED, control=CONTROL, threads=arguments.threads)
    periods, size = episodes.periods, episodes.action_size
    times = np.linspace(0, periods - 1, KNOTS)
    linear = np.array([np.interp(np.arange(periods), times, row) for row in np.eye(KNOTS)]).T  # (periods, KNOTS)
    found: dict[str, Any] = {}
    for name, method in METHODS.items():
        speeds, misses, begun = [], [], time.process_time()
        for seed in arguments.seeds:
            rng, nominal, done = np.random.default_rng(seed), np.zeros((KNOTS, size)), np.zeros((periods, size))
            memory = method.begin(nominal.shape, SPREAD)
            for now in range(0, periods, EVERY):
                drawn = method.draw(rng, nominal, memory, ROLLED - 1, SPREAD)
                knots = np.clip(np.concatenate([nominal[None], drawn]), -1.0, 1.0)
                acts = np.einsum("pk,nka->npa", linear, knots)
                acts[:, :now] = done[:now]
                told = judge(episodes, lambda seen, period, acts=acts: acts[:, period], 0)
                nominal, memory = method.update(knots, -told.returns, memory, SPREAD)
                done[now : now + EVERY] = (linear @ nominal)[now : now + EVERY]
            end = judge(episodes, lambda seen, period, done=done: np.tile(done[period], (ROLLED, 1)), 0).info
            speeds.append(float(end["ball_speed"][0]))
            misses.append(float(end["miss_angle"][0]))
        spent = (time.process_time() - begun) / len(speeds)
        found[name] = {"ball_speed": speeds, "miss_angle": misses, "cpu_seconds_a_kick": spent}
        print(name, found[name], flush=True)
    return found


def published(arguments: argparse.Namespace) -> dict[str, Any]:
    """Policies of the EquiMus authors, in their own scene, by our score: the ball's linear velocity."""
    try:
        model = mujoco.MjModel.from_xml_path(str(arguments.scene))
        ball = model.body("ball").id
    except (ValueError, KeyError) as error:
        raise SystemExit(f"{arguments.scene}: is not the scene with the leg and a body named ball ({error})") from None
    if model.nv < 8 or model.nu < 2:
        raise SystemExit(
            f"{arguments.scene}: has {model.nv} rates and {model.nu} actuators, expected the leg and a ball"
        )
    found: dict[str, Any] = {}
    for path in arguments.files:
        network, data, score = published_network(path), mujoco.MjData(model), KickScore(1, THEIR_TARGET)
        mujoco.mj_forward(model, data)
        score.begin(0)
        velocity = np.zeros(6)
        for _ in range(round(KickSettings().duration / (THEIR_STEPS * model.opt.timestep))):
            # What they call the ball's velocity is that of its rotation.
            seen = np.concatenate([data.qpos[:2], data.qvel[:2], data.body(ball).xpos, data.body(ball).cvel[:3]])
            first, last = np.clip(network(seen[None].astype(np.float32))[0], *THEIR_RANGE)
            data.ctrl[:2], data.ctrl[2:] = first, last
            for _ in range(THEIR_STEPS):
                mujoco.mj_step(model, data)
                mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, ball, velocity, 0)
                score.add(np.array([0]), velocity[None, None, 3:], np.zeros((1, 1, 3)))
        found[path.name] = {"ball_speed": float(score.speed[0]), "miss_angle": float(np.degrees(score.miss[0]))}
    return found


def published_network(path: Path) -> Network:
    """The weights alone of a file of Stable-Baselines3: nothing in it is run."""
    import torch

    try:
        with zipfile.ZipFile(path) as archive:
            held = torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=True, map_location="cpu")
        layers = sorted((name for name in held if LAYER.fullmatch(name)), key=lambda name: int(name.split(".")[2]))
        names = [*(name.removesuffix(".weight") for name in layers), "action_net"]
        parts = [[held[f"{name}.{kind}"].numpy() for name in names] for kind in ("weight", "bias")]
        network = Network(*map(tuple, parts), (*("tanh",) * len(layers), "identity"))
    except (OSError, KeyError, ValueError, zipfile.BadZipFile, pickle.UnpicklingError, eq.EquimusError) as error:
        raise SystemExit(f"{path}: is no policy of Stable-Baselines3's PPO with linear layers ({error})") from None
    if (network.inputs, network.outputs) != THEIR_SIZES:
        raise SystemExit(
            f"{path}: takes {network.inputs} numbers and gives {network.outputs}, expected {THEIR_SIZES[0]} and "
            f"{THEIR_SIZES[1]}: two positions, two rates, the ball's position and turning rate; two pressures"
        )
    return network


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(required=True)
    one = verbs.add_parser("train")
    one.add_argument("--seeds", type=int, nargs="+", default=[3, 4, 5, 6, 7])
    one.add_argument("--steps", type=int, default=2_000_000, help="of each training")
    one.add_argument("--threads", type=int, help="of the simulation; all cores by default")
    one.add_argument("--output", type=Path, default=Path("results/kick"))
    one.set_defaults(work=train)
    theirs = verbs.add_parser("published")
    theirs.add_argument("files", type=Path, nargs="+", help="ppo_kick_model_*.zip")
    theirs.add_argument("--scene", type=Path, required=True, help="their MJCF file of leg and ball")
    theirs.set_defaults(work=published)
    planned = verbs.add_parser("mpc")
    planned.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    planned.add_argument("--threads", type=int, help="of the simulation; all cores by default")
    planned.set_defaults(work=plan)
    other = verbs.add_parser("transfer")
    other.add_argument("--diagnosis", type=Path, required=True, help="folder with record.json and corrected.toml")
    other.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS))
    other.add_argument("--draws", type=int, default=200)
    other.add_argument("--seed", type=int, default=0)
    other.add_argument("--steps", type=int, default=3_000_000, help="of each way's training")
    other.add_argument("--history", type=int, default=10)
    other.add_argument("--robots", type=int, default=256, help="that each way trains on, where they differ")
    other.add_argument("--threads", type=int, help="of the simulation; all cores by default")
    other.add_argument("--output", type=Path, default=Path("results/kick"))
    other.set_defaults(work=transfer)
    arguments = parser.parse_args()
    print(json.dumps(arguments.work(arguments), indent=1))


if __name__ == "__main__":
    main()
