"""This package's controllers beside other packages' on the same plants, the same noise and the same lateness.

1. stabilise: a cart-pole from 0.2 rad; swing_up: the same from hanging (1 mrad and 1 mm of noise).
2. arm: two joints, the tip round a triangle, masses ±15 %, 2 mrad of noise, commands 20 ms late that nobody is told of.
3. speed: six joints, NMPC of 20 intervals: processor time of a step.
4. triangle: LQR and NMPC beside the tuned PID with and without feed-forward, any robot, as under 2.

    python benchmarks/controllers.py [--work stabilise --work arm …] [--draws 5] [--seed 0] [--robots DIR]
        [--controller NAME …] [--json FILE] [--figure FILE]

Peers are python-control's LQR, do-mpc's NMPC and judo's sampling planner (pip install -e '.[peers]'), wrapped as a
user's own controllers; who is not installed takes no part. ``--robots`` has ``arm2.xml`` and ``ur5e.xml``, and
``so101.xml`` for the triangle; without these the works on them are left out.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _controller_works import (
    FEEDS,
    Row,
    Work,
    arm,
    driven,
    speed,
    stabilise,
    swing_up,
    table_rows,
    triangle,
    with_motors,
)
from _peers import PEERS, lines_of, missing, version

import equimus_ctrl as eq
from equimus_ctrl.report import style
from equimus_ctrl.workflow import load_model

HERE = Path(__file__).resolve().parent
ROBOTS = HERE.parent.parent / "shared" / "recordings" / "concealed_robots" / "robots"
WORKS = ("stabilise", "swing_up", "arm", "speed", "triangle")
SHOWN = ("arm2", "so101", "so101 motors", "ur5e")
"""Robots of the triangle."""
NEEDS = {
    "lqr": ("a name", "the XML", "exact, by the package", "none"),
    "nmpc": ("a name", "the XML", "exact, by the package", "none"),
    "sampling": ("a name", "the XML", "exact, by the package", "none"),
    "python-control": ("a class", "the XML", "finite differences, by MuJoCo", "4, by hand"),
    "do-mpc": ("a class", "equations in CasADi, here eq.accelerations", "exact, by CasADi", "3 and the estimator's"),
    "judo": ("a class", "the XML", "none", "3, spread, horizon, knots"),
}
"""Controller → what its user writes, the model, the derivatives, weights."""
COLOURS = {
    "lqr": "#0072B2",
    "lqr 1 Hz": "#66A9D9",
    "nmpc": "#009E73",
    "sampling": "#AA4499",
    "python-control": "#E69F00",
    "do-mpc": "#D55E00",
    "judo": "#56B4E9",
    "pid none": "#8A8A8A",
    "pid hold": "#5A5A5A",
    "pid inverse": "#222222",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", choices=WORKS, action="append", help="these alone; all but the triangle by default")
    parser.add_argument("--controller", action="append", help="these alone")
    parser.add_argument("--robot", choices=SHOWN, action="append", help="of the triangle, these alone")
    parser.add_argument("--draws", type=int, default=5, help="robots and noise of each work")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--leg", type=float, default=1.0, help="from corner to corner [s]")
    parser.add_argument("--candidates", type=int, default=24, help="of the PID's tuning")
    parser.add_argument("--gains", type=Path, help="folder in which the PID's gains are kept and found again")
    parser.add_argument("--robots", type=Path, default=ROBOTS)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args()
    rows: list[Row] = []
    runs: dict[tuple[str, str], eq.Run] = {}
    away = {peer: why for peer in PEERS if (why := missing(peer))}
    for why in away.values():
        print(f"{why}; it takes no part")
    for name in given.work or WORKS[:-1]:
        for work in works(name, given):
            for controller in work.makers:
                if controller in away or (given.controller and controller not in given.controller):
                    continue
                for draw, robot in enumerate(work.robots(given.draws, given.seed)):
                    row, done = driven(work, controller, robot, draw, given.seed)
                    rows.append(row)
                    if done is not None:
                        runs.setdefault((work.name, controller), done)
                own = [row for row in rows if (row.work, row.robot, row.controller) == key_of(rows[-1])]
                print(line(own), flush=True)
                keep(given.json, rows, given)
                if given.figure:
                    style.save(figure(rows, runs), given.figure)
    print("\n" + needs(away))
    if "triangle" in (given.work or ()):
        print("\n" + goal(rows))


def works(name: str, given: argparse.Namespace) -> list[Work]:
    """Those of a name whose robots are there; of others it is said that they are not."""
    if name in ("stabilise", "swing_up"):
        print(head(name))
        return [{"stabilise": stabilise, "swing_up": swing_up}[name]()]
    needed = {"arm": ("arm2",), "speed": ("ur5e",)}.get(name, tuple(given.robot or SHOWN))
    found: list[Work] = []
    print(head(name))
    for robot in needed:
        file = given.robots / f"{robot.partition(' ')[0]}.xml"
        if not file.is_file():
            print(f"{name}: {file} is not there; left out")
        elif name != "triangle":
            found.append({"arm": arm, "speed": speed}[name](file, given.leg))
        else:
            model = with_motors(file) if robot.endswith("motors") else load_model(file)
            found.append(triangle(model, given.leg, given.candidates, given.seed, given.gains))
    return found


# --- what is printed ----------------------------------------------------------------------------------------------


def key_of(row: Row) -> tuple[str, str, str]:
    return row.work, row.robot, row.controller


def head(work: str) -> str:
    return (
        f"\n{work}\n{'robot':14s} {'controller':16s} {'failed':>8s} {'rmse':>14s} {'tip':>12s} {'offset':>8s} "
        f"{'swing':>7s} {'there':>7s} {'step':>7s} {'p99':>8s} {'unsolved':>9s}\n"
        f"{'':14s} {'':16s} {'':>8s} {'mrad (worst)':>14s} {'mm (worst)':>12s} {'mrad':>8s} {'mrad':>7s} {'s':>7s} "
        f"{'ms':>7s} {'ms':>8s} {'%':>9s}"
    )


def of(rows: Sequence[Row], key: str) -> np.ndarray:
    """What is known of a figure."""
    values = np.array([getattr(row, key) for row in rows])
    return values[np.isfinite(values)]


def both(values: np.ndarray, factor: float) -> str:
    """Median and largest."""
    return f"{factor * np.median(values):.2f} ({factor * values.max():.3g})" if len(values) else "–"


def one(values: np.ndarray, factor: float) -> str:
    return f"{factor * np.median(values):.2f}" if len(values) else "–"


def line(rows: Sequence[Row]) -> str:
    """A row of the table: medians over draws that did not fail, and the largest of these."""
    sound = [row for row in rows if not row.failure]
    failed = f"{len(rows) - len(sound)}/{len(rows)}"
    why = next((f"   {row.failure[:90]}" for row in rows if row.failure), "")
    return (
        f"{rows[0].robot:14s} {rows[0].controller:16s} {failed:>8s} {both(of(sound, 'rmse'), 1e3):>14s} "
        f"{both(of(sound, 'tip'), 1e3):>12s} {one(of(sound, 'offset'), 1e3):>8s} {one(of(sound, 'swing'), 1e3):>7s} "
        f"{one(of(sound, 'arrival'), 1):>7s} {one(of(rows, 'median'), 1e3):>7s} {one(of(rows, 'p99'), 1e3):>8s} "
        f"{one(of(rows, 'unsolved'), 100):>9s}{why}"
    )


def needs(away: Mapping[str, str]) -> str:
    """What each asks of its user."""
    text = [f"{'controller':16s} {'lines':>6s}  {'version':10s} {'model':44s} {'derivatives':32s} weights"]
    for name, (_, model, derivatives, weights) in NEEDS.items():
        peer = name in PEERS
        lines = str(lines_of(name)) if peer else "1"
        said = ("–" if name in away else version(name)) if peer else eq.__version__
        text.append(f"{name:16s} {lines:>6s}  {said:10s} {model:44s} {derivatives:32s} {weights}")
    return "\n".join(text)


def goal(rows: Sequence[Row]) -> str:
    """By robot the error of each controller over that of the PID without feed-forward, draw by draw."""
    text = ["error of the joints over that of the tuned PID without feed-forward: median (largest) of the draws"]
    for robot in dict.fromkeys(row.robot for row in rows if row.work == "triangle"):
        own = [row for row in rows if row.work == "triangle" and row.robot == robot and not row.failure]
        base = {row.draw: row.rmse for row in own if row.controller == next(iter(FEEDS))}
        for name in dict.fromkeys(row.controller for row in own):
            ratios = np.array([row.rmse / base[row.draw] for row in own if row.controller == name and row.draw in base])
            if len(ratios) and name != next(iter(FEEDS)):
                text.append(f"  {robot:14s} {name:16s} {np.median(ratios):.3f} ({ratios.max():.3f})")
    return "\n".join(text)


def keep(file: Path | None, rows: Sequence[Row], given: argparse.Namespace) -> None:
    """Write what is known so far."""
    if file is None:
        return
    versions = {"equimus-ctrl": eq.__version__, **{peer: version(peer) for peer in PEERS}}
    lines = {peer: lines_of(peer) for peer in PEERS}
    said: dict[str, Any] = {"seed": given.seed, "draws": given.draws, "versions": versions, "lines": lines}
    file.write_text(json.dumps({**said, "rows": table_rows(rows)}, indent=1), encoding="utf-8")


# --- the figure ---------------------------------------------------------------------------------------------------


def figure(rows: Sequence[Row], runs: Mapping[tuple[str, str], eq.Run]) -> Any:
    """Poles that are swung up, and for each work on arms what a step costs against how far off the tip is."""
    names = dict.fromkeys(row.work for row in rows)
    poles = [name for name in ("stabilise", "swing_up") if name in names]
    others = [name for name in ("arm", "triangle") if name in names]
    others = others or ["speed"] * (not poles)
    whole = style.new_figure(5.2 * (len(poles) + len(others)), 4.8, "Controllers on the same plants")
    axes = np.atleast_1d(whole.subplots(1, len(poles) + len(others)))
    for ax, name in zip(axes, poles, strict=False):
        style.dress(ax, title={"stabilise": "Pole from 0.2 rad", "swing_up": "Pole swung up"}[name], x="time [s]",
                    y="pole from upright [°]")  # fmt: skip
        for (work, controller), done in runs.items():
            if work == name and done.truth is not None:
                angle = np.degrees(np.unwrap(done.truth[:, 1]))
                angle = angle - 360 * np.round(angle[-1] / 360)
                ax.plot(done.time, angle, color=COLOURS[controller], lw=1.4, label=controller)
        if name == "stabilise":
            ax.set_xlim(0, 3)
        ax.axhline(0, color=style.FAINT, lw=0.8, zorder=0)
        ax.legend(frameon=False, fontsize=style.SMALL_SIZE)
    for ax, name in zip(axes[len(poles) :], others, strict=True):
        title = "Two joints, tip round a triangle" if name == "arm" else "Tips round a triangle"
        style.dress(ax, title=title, x="processor time of a step, median [ms]", y="tip off its path, RMSE [mm]")
        ax.set_xscale("log")
        ax.set_yscale("log")
        own = [row for row in rows if row.work == name and np.isfinite(row.tip)]
        for controller in dict.fromkeys(row.controller for row in own):
            each = [row for row in own if row.controller == controller]
            for failed in (False, True):
                at = [(1e3 * row.median, 1e3 * row.tip) for row in each if bool(row.failure) == failed]
                if at:
                    x, y = np.array(at).T
                    label = None if failed and len(at) < len(each) else controller
                    kind = "x" if failed else "o"
                    ax.scatter(x, y, s=26, color=COLOURS[controller], marker=kind, alpha=0.75, label=label)
        ax.legend(frameon=False, fontsize=style.SMALL_SIZE)
    return whole


if __name__ == "__main__":
    main()
