"""How often and how soon the sampling controller swings robots up: ``python benchmarks/swing_up.py``.

Every seed has noise of its own on the measured positions and draws of its own. A run has arrived once every hinge stays
within 10° of the upright pose, and every slide within 100 mm, until its end and for a second at least.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

import equimus_ctrl as eq
from equimus_ctrl import workflow

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
CASES = {"cartpole": 6.0, "acrobot": 10.0}
"""Robot → time in which it is to be upright [s]; a run lasts a second longer."""


def main() -> None:
    parser = argparse.ArgumentParser(description="Time until upright, seed by seed.")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="seed")
    parser.add_argument(
        "--noise", type=float, default=1e-3, help="of measured positions, standard deviation [rad or m]"
    )
    parser.add_argument("--robot", choices=CASES, action="append", help="these alone")
    parser.add_argument("--samples", type=int, default=eq.SamplingSettings().samples)
    given = parser.parse_args()
    for name in given.robot or CASES:
        model, limit, times, steps = workflow.load_model(EXAMPLES / f"{name}.xml"), CASES[name], [], []
        begun = time.perf_counter()
        for seed in range(given.first, given.first + given.seeds):
            controller = eq.SamplingController(eq.SamplingSettings(seed=seed, samples=given.samples))
            options = {"duration": str(limit + 1.0)}
            done = workflow.run_scenario(
                "swing_up", controller, model=model, options=options, noise=given.noise, seed=seed
            )
            assert done.score.arrival is not None
            times.append(done.score.arrival.time)
            steps.append(done.score.solve_time[0])
            print(f"{name}, seed {seed}: {times[-1]:.2f} s", flush=True)
        found = np.array(times)
        arrived = found[found <= limit]
        figures = {
            "robot": name,
            "arrived": len(arrived),
            "seeds": given.seeds,
            "limit_s": limit,
            "median_s": float(np.median(arrived)) if len(arrived) else None,
            "longest_s": float(arrived.max()) if len(arrived) else None,
            "step_ms": 1e3 * float(np.median(steps)),
            "wall_s": time.perf_counter() - begun,
        }
        print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
