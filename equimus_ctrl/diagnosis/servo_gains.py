"""Whether position servos are as stiff as a model says, from how far joints stay behind their goals.

A servo of stiffness k holds a force f where its joint is f/k away from the goal, so along a measured motion

    goal − q = f/k + a·q̇ + b·sign q̇ + c·q̈ + d

f being what bodies and gravity need by the model (``engines.mjcf_inverse``); friction, the servo's own damping, latency
and rotor inertia are in a, b and c. Least squares give 1/k. Where f hardly varies, f/k and d stand in for each other,
and what these laws leave of friction would choose between them; d is 0 then. Noise of the positions is in goal − q
alone, where it does not bias it. A model whose servos are ten times too stiff predicts next to nothing of what was
measured, and everything else that is missing would be looked for on top of that.

Where drives are no standard of force, the bodies are: masses and inertias are taken to be known then. A joint that
neither gravity nor other joints load tells the ratio of stiffness, friction and rotor inertia alone, so its servo is
taken to be as much softer as the others. With k known, k·a, k·b and k·c are where estimates of the joint's damping, dry
friction and rotor inertia begin.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.plausibility import LONG_ENOUGH, UNIT
from equimus_ctrl.engines.mjcf_inverse import InverseDynamics, MeasuredMotion, inverse_dynamics, motions_of
from equimus_ctrl.identification.noise import noise_of_differences
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import mjcf_of
from equimus_ctrl.types import Array

WIDTHS = (4, 8, 16)
"""Widths of test functions in samples."""
SHOWN = 0.05
"""Share of how far a joint stays behind, beside what goes with its own motion, from which on its load is shown."""
VARIES = 0.5
"""Share of its load that varies, from which on a joint's constant distance from its goal is told from what it bears."""
LEAST_ROWS = 30
"""Fewer independent samples show nothing."""
WITHIN = 10.0
"""A stiffness that is estimated from here is taken to be right within this factor."""
LOADED = 0.05
"""Share of its load that does not go with its own motion, from which on a joint is loaded by others or gravity."""
NO_LIMIT = 1e6
"""Of a force or a voltage, to see what a servo would do without its own."""
NO_ROTOR = 1e-9
"""Rotor inertia of none: MuJoCo's parameters of it stay above 0."""


@dataclass(frozen=True)
class ServoGain:
    """The stiffness of a servo.

    Attributes:
        name: of the model's parameter.
        joint: that it drives.
        model: its value by the model [N·m/rad or N/m].
        measured: by the recordings; that of servos alike where its own joint does not show it.
        loaded: whether its own joint shows it.
        joint_begins: where estimates of the joint's own parameters begin, by the same regression.
    """

    name: str
    joint: str
    model: float
    measured: float
    loaded: bool
    joint_begins: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Rows:
    """What a joint shows, one row a test function, of those through which it moves.

    Attributes:
        needed: (n,) forces that bodies and gravity need [N·m or N].
        behind: (n,) how far the joint stays behind [rad or m].
        others: (n, 4) a constant, and the joint's rate, its sign and the joint's acceleration.
    """

    needed: Array
    behind: Array
    others: Array

    @cached_property
    def varies(self) -> bool:
        """Whether the load varies enough to tell it from a constant."""
        load, bears = _beside(self.needed, self.others), _beside(self.needed, self.others[:, 1:])
        return not float(load @ load) < VARIES * float(bears @ bears)

    @property
    def beside(self) -> Array:
        """Those of the others that are estimated beside the load."""
        return self.others if self.varies else self.others[:, 1:]

    def compliance(self) -> tuple[float, float]:
        """1/k of a servo, and the share that it has of how far the joint stays behind beside all else; 0 of no load."""
        if len(self.needed) < LEAST_ROWS:
            return 0.0, 0.0
        load, rest = _beside(self.needed, self.beside), _beside(self.behind, self.beside)
        square = float(load @ load)
        if square < LOADED * float(np.sum((self.needed - self.needed.mean()) ** 2)):
            return 0.0, 0.0
        across = float(load @ rest)
        return across / square, across**2 / max(square * float(rest @ rest), 1e-300)

    def laws(self, stiffness: float) -> dict[str, float]:
        """The joint's damping, dry friction and rotor inertia, its servo's stiffness being known."""
        over = stiffness * self.behind - self.needed
        found = np.linalg.lstsq(self.beside, over, rcond=1e-9)[0][-3:]
        return dict(zip(("damping", "frictionloss", "armature"), map(float, found), strict=True))


def servo_gains(model: Model, segments: Sequence[Segment]) -> tuple[ServoGain, ...]:
    """Stiffnesses of a robot's position servos, where they are far from what the model says; none where they are not.

    Far is a factor of ``plausibility.UNIT``. They decide what is free, so nothing that is held out may be among them,
    see ``holdout.never_held_out``.

    Args:
        model: of any robot.
        segments: of recordings that are fitted, uncut.
    """
    if not segments or not model.robot.has_torque_domain:
        return ()
    robot, values = mjcf_of(model.robot), model.robot.parameters()
    servos = {f"{d.actuator}.kp": d.joint for d in robot.actuators if d.servo and f"{d.actuator}.kp" in values}
    if not servos or len(servos) < len(robot.actuators):
        return ()
    measured = [s.measured for s in segments]
    noise = np.array([own.sigma for own in noise_of_differences(measured)])
    motions = motions_of([s.trial for s in segments], measured, noise)
    shown = _shown(_bodies_alone(model), motions, values, servos)
    own = _stiffnesses(shown)
    shares = [stiffness / values[name] for name, (stiffness, _) in own.items()]
    if not any(not 1 / UNIT < share < UNIT for share in shares):
        return ()
    usual, width = float(np.median(shares)), sorted(width for _, width in own.values())[len(own) // 2]
    found = []
    for name, joint in servos.items():
        stiffness, at = own.get(name, (usual * values[name], width))
        laws = {f"{joint}.{key}": value for key, value in shown[name, at].laws(stiffness).items()}
        begins = {key: value for key, value in laws.items() if key in values and value > 0}
        found.append(ServoGain(name, joint, values[name], stiffness, name in own, begins))
    return tuple(found)


def _bodies_alone(model: Model) -> Model:
    """The model without friction and rotor inertias, and its servos without limits."""
    without = {
        ".force_limit": NO_LIMIT,
        ".voltage_limit": NO_LIMIT,
        ".damping": 0.0,
        ".frictionloss": 0.0,
        ".armature": NO_ROTOR,
    }
    kinds = {name: without.get(name[name.rfind(".") :]) for name, value in model.robot.parameters().items() if value}
    return model.with_parameters({name: value for name, value in kinds.items() if value is not None})


def _shown(
    model: Model, motions: Sequence[MeasuredMotion], known: Mapping[str, float], servos: Mapping[str, str]
) -> dict[tuple[str, int], _Rows]:
    """What the joint of each servo shows, at each width of test functions."""
    found: dict[tuple[str, int], _Rows] = {}
    for width in WIDTHS:
        long = [m for m in motions if len(m.time) > LONG_ENOUGH * width]
        if not long:
            break
        at = inverse_dynamics(model, long, width)
        for name, joint in servos.items():
            found[name, width] = _rows(long, at, model.robot.joint_names.index(joint), width, known[name])
    return found


def _rows(motions: Sequence[MeasuredMotion], at: Sequence[InverseDynamics], j: int, width: int, k: float) -> _Rows:
    """What a joint shows whose servo has a stiffness k by the model."""
    behind, needed, others = list[Array](), list[Array](), list[Array]()
    for motion, one in zip(motions, at, strict=True):
        rate, moving = one.rate[:, j], one.counts[:, j]
        step = motion.interval * max(width // 2, 1)
        needed.append(one.weighted(one.missing[:, j] + one.drives[:, j])[moving])
        behind.append(one.weighted(one.drives[:, j] / k)[moving])
        parts = (np.ones_like(rate), rate, np.sign(rate), np.gradient(rate, step))
        others.append(one.weighted(np.column_stack(parts))[moving])
    return _Rows(*map(np.concatenate, (needed, behind, others)))


def _stiffnesses(shown: Mapping[tuple[str, int], _Rows]) -> dict[str, tuple[float, int]]:
    """The stiffness of each servo that shows it, and the width of test functions at which it shows it best."""
    best: dict[str, tuple[float, float, int]] = {}
    for (name, width), rows in shown.items():
        slope, share = rows.compliance()
        if slope > 0 and share > max(SHOWN, best.get(name, (0.0, 0.0, 0))[1]):
            best[name] = slope, share, width
    return {name: (1 / slope, width) for name, (slope, _, width) in best.items()}


def _beside(whole: Array, others: Array) -> Array:
    """What is left of a column beside others, by least squares."""
    return whole - others @ np.linalg.lstsq(others, whole, rcond=1e-9)[0]


def with_servo_gains(
    free: FreeParameters,
    gains: Sequence[ServoGain],
    bounds: Mapping[str, tuple[float, float]] | None = None,
    fix: Sequence[str] = (),
) -> FreeParameters:
    """What is free where servos are far from what the model says: their stiffnesses too, and no masses and inertias.

    Of a joint without load that has a rotor inertia this is free in the stiffness' place. Gains on rates, which one
    firmware scales as much, begin softer too. They are free where joint damping is not; else they are so in the model
    whose parameters are free.

    Args:
        free: where they are not; by default, see ``default_free_parameters``.
        gains: what was measured.
        bounds: (low, high) of some parameters.
        fix: names or patterns of what stays as it is all the same.
    """
    if not gains:
        return free
    model, robot, values = free.model, mjcf_of(free.model.robot), free.model.parameters()
    bodies = {n.name for n in robot.plan.parameters.values() if n.kind in ("mass", "inertia", "armature")}
    rotors = {f"{g.joint}.armature" for g in gains if values[f"{g.joint}.armature"] > 0}
    # A joint without load tells of its servo what it tells of its rotor.
    stiff = {g.name: g.measured for g in gains if g.loaded or f"{g.joint}.armature" not in rotors}
    as_others = {g.name: g.measured for g in gains if g.name not in stiff}
    rates = {g.name.removesuffix(".kp") + ".kv": g for g in gains}
    softer = {name: values[name] * g.measured / g.model for name, g in rates.items() if values.get(name, 0.0) > 0}
    # A servo's gain on the rate does what the joint's damping does, so one of them is free.
    own = {name for name in softer if f"{rates[name].joint}.damping" not in free.names}
    names = [name for name in values if name in (set(free.names) - bodies) | rotors | stiff.keys() | own]
    within = {name: (k / WITHIN, k * WITHIN) for name, k in stiff.items()}
    within |= {name: (0.0, values[name] * WITHIN) for name in own}
    within |= {name: ends for name, ends in (bounds or {}).items() if name in names}
    joints = {name: value for g in gains for name, value in g.joint_begins.items() if name in names}
    begin = model.with_parameters({**stiff, **as_others, **softer, **joints})
    kept = as_others | {name: value for name, value in softer.items() if name not in own}
    return FreeParameters(model.with_parameters(kept), default_free_parameters(begin, names, within, fix).free)


def told(gains: Sequence[ServoGain]) -> str:
    """A sentence for the report."""
    servos = ", ".join(f"{g.name} {g.model:.4g} → {g.measured:.3g}" for g in gains)
    unloaded = ", ".join(g.joint for g in gains if not g.loaded)
    alike = (
        f" Nothing loads {unloaded}, so their servos were taken to be as much softer as the others." if unloaded else ""
    )
    return (
        f"The servos are not as stiff as the model says, by how far joints stay behind their goals ({servos}): their "
        f"stiffnesses were estimated, and masses and inertias taken to be known.{alike}"
    )
