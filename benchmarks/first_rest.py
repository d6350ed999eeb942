"""Does the leg come to its first rest in time? ``python benchmarks/first_rest.py [--legs 480] [--seed 0] [-c pid]``.

The legs are those that tuning draws (stiffness and areas ±15 %, damping ±40 %, rest lengths ±2 %, masses ±10 %, valves
0 to 0.1 s late and 0.02 to 0.12 s slow), and the nominal one behind valves in the middle of these ranges; the
controller knows the nominal leg. From rest each goes to (90°, 0°). A joint has come to rest when its true angle stays
within 0.5° of the pose from 2 s on; it overshoots by how far it goes past the pose, as a share of its way there.
"""

from __future__ import annotations

import argparse
import json

import numpy as np
from rich.progress import track

import equimus_ctrl as eq
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.tuning.ensemble import make_members
from equimus_ctrl.tuning.study import EnsembleSettings
from equimus_ctrl.types import Array

POSE = {"hip": "90", "knee": "0", "duration": "5"}
WITHIN, AT = np.radians(0.5), 2.0
"""Distance from the pose [rad], and from when on it counts [s]."""


def first_rest(leg: Model, controller: str, seed: int) -> tuple[Array, Array]:
    """(2,) when each joint has come to rest for good [s], and (2,) its overshoot as a share of its way."""
    done = eq.run_scenario(
        "hold", controller, model=leg, nominal=nominal_model(), options=POSE, noise=EnsembleSettings().noise, seed=seed
    )
    run = done.run
    assert run.truth is not None
    pose = np.radians([90.0, 0.0])
    away = np.abs(run.truth - pose)
    late = [run.time[np.flatnonzero(own > WITHIN)[-1]] if (own > WITHIN).any() else 0.0 for own in away.T]
    way = pose - run.truth[0]
    past = ((run.truth - pose) * np.sign(way)).max(axis=0)
    return np.array(late), np.maximum(past, 0.0) / np.maximum(np.abs(way), 1e-9)


def main() -> None:
    """Draw, run and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--legs", type=int, default=480)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-c", "--controller", default="pid")
    given = parser.parse_args()
    middle, *_ = make_members(nominal_model(), EnsembleSettings(), 1, given.seed)
    late, past = first_rest(middle, given.controller, given.seed)
    print(f"model: at rest after {late[0]:.2f} and {late[1]:.2f} s, overshoots {past[0]:.1%} and {past[1]:.1%}")
    legs = make_members(nominal_model(), EnsembleSettings(), given.legs, given.seed, fixed=False)
    found = [first_rest(leg, given.controller, given.seed + k) for k, leg in enumerate(track(legs, transient=True))]
    lates, pasts = (np.array(rows) for rows in zip(*found, strict=True))
    print(
        json.dumps(
            {
                "legs": given.legs,
                "both_at_rest_in_time": float((lates <= AT).all(axis=1).mean()),
                "in_time": (lates <= AT).mean(axis=0).tolist(),
                "median_rest_s": float(np.median(lates.max(axis=1))),
                "overshoot_beyond_5_percent": (pasts > 0.05).mean(axis=0).tolist(),
                "largest_overshoot": pasts.max(axis=0).tolist(),
            },
            indent=1,
        )
    )


if __name__ == "__main__":
    main()
