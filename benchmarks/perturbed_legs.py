"""Are controllers that know only the nominal leg stable on others, and do they leave no offset at rest?

Stiffness, areas and masses ±15 %, damping ±40 %, rest lengths ±2 %, 2 mrad of noise; with `--late` behind valves with
0.1 s of lag and 0.1 s late, which are known. The leg goes to a pose and holds it. At rest is the last second: the
offset is the mean of the true error, and what swings is the true error's standard deviation.

    python benchmarks/perturbed_legs.py [--draws 100] [--seed 0] [--seconds 10] [--late] [-c NAME …] [--output FILE]
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.progress import track

from equimus_ctrl.effects import FirstOrderLag, TransportDelay
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.workflow import compare

GOAL = 0.005
"""Offset at rest [rad]."""
SWINGS = 0.01
"""Who moves by more at rest is unstable [rad]."""
POSE = {"hip": "85", "knee": "35"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--late", action="store_true")
    parser.add_argument("-c", "--controller", action="append")
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    model = nominal_model()
    if given.late:
        late = [kind(name, 0.1) for name in model.morphology.actuator_names for kind in (FirstOrderLag, TransportDelay)]
        model = replace(model, effects=tuple(late))
    record = {}
    for controller in given.controller or ["pid", "lqr", "nmpc"]:
        shares = iter(track(range(given.draws), controller, transient=True))
        seen = {"done": 0}

        def notify(share: float, what: str, shares: object = shares, seen: dict[str, int] = seen) -> None:
            while seen["done"] < round(share * given.draws):
                next(shares, None)  # type: ignore[call-overload]
                seen["done"] += 1

        options = {**POSE, "duration": f"{given.seconds:g}"}
        found = compare(
            ["hold"], [controller], ["perturbed"], model=model, draws=given.draws, scenario_options=options,
            seed=given.seed, notify=notify,
        )  # fmt: skip
        offsets, swings, fallbacks = [], [], 0.0
        for entry in found.entries:
            if entry.run is None or entry.run.truth is None:
                continue
            rest = (entry.run.truth - entry.run.reference)[entry.run.time >= given.seconds - 1.0]
            offsets.append(np.abs(rest.mean(axis=0)).max())
            swings.append(rest.std(axis=0).max())
            fallbacks += entry.fallbacks / given.draws
        record[controller] = {
            "ended_early": len(found.failures),
            "unstable": int(np.sum(np.array(swings) > SWINGS)) + len(found.failures),
            "offset_over_goal": int(np.sum(np.array(offsets) > GOAL)),
            "largest_offset_rad": float(np.max(offsets)),
            "largest_swing_rad": float(np.max(swings)),
            "fallback_share": fallbacks,
        }
        print(controller, json.dumps(record[controller]), flush=True)
    if given.output:
        given.output.write_text(json.dumps(record, indent=1))


if __name__ == "__main__":
    main()
