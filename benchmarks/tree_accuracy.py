"""How near the reduced engine's motions of random trees are to what MuJoCo's tend to as its step tends to zero.

Each tree moves for 3 s under random commands from rest at ``qpos0``, see ``validation/random_trees.py``; the largest
difference of any joint [rad, m] is printed for each of the reduced engine's steps. The reference is ``converged``:
MuJoCo's q̈ and ȧ integrated with an error-controlled method of eighth order; ``own error`` is how much its last
refinement changed it. ``RK4`` is how far ``mj_step`` with a step of 0.025 ms still is from it, ``halving`` how much
halving that step changed: where a law switches, RK4 in MuJoCo is of first order. ``growth`` is by how much a start that
is shifted a little comes further apart in 3 s, so it tells of chaos. Trees that compiled equations cannot hold are
drawn again, and so are those whose reference cannot be followed.

    python benchmarks/tree_accuracy.py [--trees 12] [--seed 0] [--joints 4 5 6 7] [--mjcf FILE.xml ...]

With ``--friction`` every tree has dry friction that acts. MuJoCo's is a soft constraint, so the reference is
``mj_step`` with RK4 at a step of 0.005 ms and friction as hard as that step allows; its error goes with the step.
``own error`` is what halving that step changed, ``extrapolated`` how far the reduced engine's finest motion is from the
reference without its error of first order (Richardson, 1911).

    python benchmarks/tree_accuracy.py --friction [--trees 6] [--seed 0] [--joints 1 2 3 4 5 6] [--mjcf FILE.xml ...]

With ``--keep FOLDER`` the trees are written there.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ModelError, SimulationDiverged
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array
from equimus_ctrl.validation.random_trees import (
    FEATURES,
    FRICTION,
    SMOOTH,
    acting,
    controls,
    converged,
    random_tree,
    reference,
)

DURATION = 3.0
STEPS = 2.5e-4, 1e-4, 5e-5
"""Of the reduced engine [s]."""
FINE, FINEST = 2.5e-5, 5e-6
"""Steps of MuJoCo's RK4: beside the limit, and as the reference of dry friction [s]."""
SHIFT = 1e-7
"""Of the start, for ``growth`` [rad, m]."""
ATTEMPTS = 20


@dataclass(frozen=True, eq=False)
class Motion:
    """A tree, its commands, and the motion that the reduced engine is compared with.

    Attributes:
        name: of the tree.
        xml: MJCF.
        times: (n,) of the commands [s].
        ctrl: (n, nu).
        at: (m,) when positions are compared [s].
        q: (m, nq) the reference [rad, m].
        own: error of the reference [rad, m].
        coarse: (m, nq) the reference at twice its step, where it is one of a step.
        acting: features that act.
    """

    name: str
    xml: str
    times: Array
    ctrl: Array
    at: Array
    q: Array
    own: float
    coarse: Array | None
    acting: frozenset[str]

    @classmethod
    def of(cls, name: str, xml: str, rng: np.random.Generator, friction: bool) -> Motion:
        """Of a tree under commands of its own.

        Raises:
            SimulationDiverged: where the reference cannot be followed.
        """
        times, ctrl = controls(rng, mujoco.MjModel.from_xml_string(xml), DURATION)
        seen = acting(xml, times, ctrl)
        if friction:
            fine, coarse = (reference(xml, times, ctrl, DURATION, step) for step in (FINEST, 2 * FINEST))
            at = np.append(times, DURATION)
            return cls(name, xml, times, ctrl, at, fine, apart(fine, coarse), coarse, seen)
        limit = converged(xml, times, ctrl, DURATION)
        return cls(name, xml, times, ctrl, limit.times, limit.q, limit.change, None, seen)

    def reduced(self, step: float, shift: float = 0.0) -> Array:
        """(m, nq) by the reduced engine with a step [s]; infinite where it diverges."""
        model = mujoco.MjModel.from_xml_string(self.xml)
        none, start = np.zeros(model.nu), model.qpos0 + shift * np.cos(np.arange(model.nq))
        # MuJoCo's activations begin with nothing.
        trial = Trial("t", self.times, self.ctrl, none, 0.0, start, self.at, activation=none)
        found = simulate([Model(MjcfRobot(self.name, self.xml))], [trial], dt=step, threads=1, check=False)[0]
        return found.position[0] if found.sound.all() else np.full_like(found.position[0], np.inf)

    def row(self) -> str:
        """Columns of the table."""
        found = [self.reduced(step) for step in STEPS]
        errors = " ".join(f"{apart(q, self.q):8.1e}" for q in found)
        if self.coarse is None:
            halved, whole = (reference(self.xml, self.times, self.ctrl, DURATION, s) for s in (FINE, 2 * FINE))
            more = f"{apart(halved, self.q):8.1e} {apart(halved, whole):8.1e}"
        else:
            more = f"{apart(found[-1], 2 * self.q - self.coarse):12.1e}"
        growth = apart(self.reduced(STEPS[1], SHIFT), found[1]) / SHIFT
        return f"{errors}  {self.own:9.1e} {more} {growth:7.1f}"


def apart(one: Array, other: Array) -> float:
    """The largest difference [rad, m]."""
    return float(np.abs(one - other).max())


def drawn(name: str, rng: np.random.Generator, joints: int, friction: bool) -> Motion:
    """A random tree that compiled equations hold, with its motion."""
    for _ in range(ATTEMPTS):
        try:
            xml = random_tree(rng, joints, FEATURES if friction else SMOOTH)
        except ModelError:
            print(f"{name}: no tree was found; drawn again", flush=True)
            continue
        model = mujoco.MjModel.from_xml_string(xml)
        if friction and not (model.dof_frictionloss.any() or model.tendon_frictionloss.any()):
            continue
        if what := MjcfRobot(name, xml).obstacles:
            print(f"{name}: {what[0]}; drawn again", flush=True)
            continue
        try:
            motion = Motion.of(name, xml, rng, friction)
        except SimulationDiverged as error:
            print(f"{name}: {error}; drawn again", flush=True)
            continue
        if not friction or motion.acting & set(FRICTION):
            return motion
    raise SystemExit(f"{name}: no tree of {joints} joints in {ATTEMPTS} attempts")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trees", type=int, help="how many; 12, with --friction 6")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--joints", type=int, nargs="+", help="of the trees in turn")
    parser.add_argument("--friction", action="store_true", help="trees with dry friction")
    parser.add_argument("--mjcf", type=Path, nargs="+", default=[], metavar="FILE.xml", help="these robots too")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="write the trees there")
    args = parser.parse_args()
    trees = args.trees if args.trees is not None else 6 if args.friction else 12
    joints = args.joints or ([1, 2, 3, 4, 5, 6] if args.friction else [4, 5, 6, 7])
    steps = " ".join(f"{step * 1e3:5g} ms" for step in STEPS)
    more = "extrapolated" if args.friction else "     RK4  halving"
    print(f"{'tree':16} joints {steps}  own error {more}  growth  seconds  features", flush=True)
    seen: Counter[str] = Counter()
    jobs: list[tuple[str, Path | None, int]] = [(path.stem, path, 0) for path in args.mjcf]
    jobs += [(f"{args.seed}.{i}", None, i) for i in range(trees)]
    for name, path, index in jobs:
        begun, rng = time.perf_counter(), np.random.default_rng([args.seed, index])
        if path:
            motion = Motion.of(name, path.read_text(), rng, args.friction)
        else:
            motion = drawn(name, rng, joints[index % len(joints)], args.friction)
        if args.keep:
            args.keep.mkdir(parents=True, exist_ok=True)
            (args.keep / f"{name}.xml").write_text(motion.xml)
        row, count = motion.row(), motion.q.shape[1]
        seen.update(motion.acting)
        took = time.perf_counter() - begun
        print(f"{name:16} {count:6} {row} {took:8.0f}  {' '.join(sorted(motion.acting))}", flush=True)
    wanted = FEATURES if args.friction else SMOOTH
    print(f"\n{len(set(wanted) & set(seen))} of {len(wanted)} features acted", end="")
    missing = [name for name in wanted if not seen[name]]
    print(f"; not {', '.join(missing)}" if missing else "", flush=True)


if __name__ == "__main__":
    main()
