"""How often 95 % intervals of ``identify`` hold: ``python benchmarks/intervals.py [--sets 200] [--seed 0]``.

Each set is a leg with other numbers than the nominal one (stiffness and area ±10 %, damping ±30 %, rest lengths ±2 %)
that records some trials of a scenario in MuJoCo: the PID holds a pose (another in each trial) or follows the triangle,
or valves follow a chirp, with 2 mrad of noise. What is found from the nominal leg on is set beside the truth. A row a
scenario: of how many finite intervals so many hold, the worst parameter, and how many have no end. ``--no-fit-start``
begins trials where their first rows show them, for comparison.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import equimus_ctrl as eq
from equimus_ctrl import recordings
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.types import Array, Recording

NOISE = 2e-3
SPREAD = {"stiffness": 0.1, "area": 0.1, "damping": 0.3, "rest_length": 0.02}
SCENARIOS = ("hold", "triangle", "chirp")


@dataclass
class Count:
    """Intervals of a scenario that held, of those that have an end."""

    held: list[Array] = field(default_factory=list)
    ended: list[Array] = field(default_factory=list)

    def row(self, names: tuple[str, ...]) -> str:
        held, ended = np.array(self.held), np.array(self.ended)
        each = (held & ended).sum(axis=0) / np.maximum(ended.sum(axis=0), 1)
        worst = int(np.argmin(np.where(ended.any(axis=0), each, 1.0)))
        inside, finite = int((held & ended).sum()), int(ended.sum())
        worst_said = f"{names[worst]} {each[worst]:.2f}"
        return f"{len(held)} | {inside} of {finite} ({inside / finite:.1%}) | {worst_said} | {held.size - finite}"


def drawn(rng: np.random.Generator, names: tuple[str, ...]) -> dict[str, float]:
    """Numbers of a leg."""
    nominal = nominal_model().parameters()
    return {name: nominal[name] * (1 + SPREAD[name.split(".")[-1]] * rng.uniform(-1, 1)) for name in names}


def recorded(leg: Model, scenario: str, count: int, rng: np.random.Generator) -> list[Recording]:
    """Trials of a leg whose controller knows the nominal one."""
    with tempfile.TemporaryDirectory() as folder:
        for k in range(count):
            where, seed = Path(folder) / str(k), int(rng.integers(2**31))
            pose = {"hip": f"{rng.uniform(75, 100):.3f}", "knee": f"{rng.uniform(0, 40):.3f}"}
            eq.run_scenario(
                scenario, None if scenario == "chirp" else "pid", model=leg, nominal=eq.nominal_model(),
                options=pose if scenario == "hold" else None, noise=NOISE, seed=seed, record=where,
            )  # fmt: skip
        return list(recordings.read_set([Path(folder) / str(k) for k in range(count)]))


def main() -> None:
    """Draw, identify and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=200)
    parser.add_argument("--trials", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fit-start", action=argparse.BooleanOptionalAction, default=True)
    given = parser.parse_args()
    names = tuple(free_parameters(nominal_model(), None, None, ()).names)
    counts = {scenario: Count() for scenario in SCENARIOS}
    for k in range(given.sets):
        rng = np.random.default_rng([given.seed, k])
        scenario, truth = SCENARIOS[k % len(SCENARIOS)], drawn(rng, names)
        leg = Model(eq.nominal_leg().with_parameters(truth))
        trials = recorded(leg, scenario, given.trials, rng)
        found = eq.identify_recordings(trials, folds=0, threads=1, fit_start=given.fit_start).fit
        width, count = found.uncertainty.half_width, counts[scenario]
        count.held.append(np.abs(found.theta - [truth[name] for name in names]) <= width)
        count.ended.append(np.isfinite(width))
        print(f"set {k}: {scenario}, {int(count.held[-1].sum())} of {len(names)} hold", flush=True)
    print(
        "| scenario | sets | intervals that hold | worst parameter | without an end |\n| --- | --- | --- | --- | --- |"
    )
    for scenario, count in counts.items():
        if count.held:
            print(f"| {scenario} | {count.row(names)} |")
    whole = Count([row for c in counts.values() for row in c.held], [row for c in counts.values() for row in c.ended])
    print(f"| all | {whole.row(names)} |")


if __name__ == "__main__":
    main()
