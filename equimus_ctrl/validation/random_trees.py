"""Random MuJoCo trees of hinges and slides whose features act in their motion, and converged trajectories of them.

``random_tree`` draws a robot, ``controls`` its commands, ``acting`` says which features act under them. ``reference``
is MuJoCo's RK4 at one step, ``converged`` what that tends to as the step tends to zero. Halving alone does not get
there, for RK4 in MuJoCo is of first order wherever a limit switches on, for dry friction, and for ``filterexact``,
``actearly``, a held ``actrange``, slew limits, delays, and the current and the bristle of a DC motor, whose updates
contain the step. ``converged`` therefore integrates q̈ and ȧ of ``mj_forward`` with an error-controlled method of eighth
order (DOP853 of Hairer, Nørsett & Wanner, *Solving Ordinary Differential Equations I*), the step within MuJoCo's laws
set to nothing.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
from mujoco.rollout import rollout
from scipy.integrate import DOP853

from equimus_ctrl.errors import ConfigError, ModelError, SimulationDiverged
from equimus_ctrl.types import Array

# In these tables "{a:b}" stands for a number drawn between a and b, in the units of a hinge: rad, N·m.
_LIMIT = {"range": "{-0.3:-0.05} {0.05:0.3}"}
_TIGHT = {"range": "{-0.15:-0.03} {0.03:0.15}"}
_OWN = "{0.02:0.06} {0.5:1.5}", "{0:0.6} {0.8:0.99} {0.05:0.3} {0.2:0.8} {1:4}"
_SOLVER = _LIMIT | {"solreflimit": _OWN[0], "solimplimit": _OWN[1], "margin": "{0:0.05}"}
_DAMPING = {"damping": "{0.1:0.3} {0.05:0.2} {0.02:0.1}"}
_JOINT: dict[str, dict[str, str]] = {
    "armature": {"armature": "{0.01:0.05}"},
    "joint_spring": {"stiffness": "{1:4}", "springref": "{-0.5:0.5}"},
    "joint_spring_poly": {"stiffness": "{2:4} {-0.6:0.9} {0.6:3}", "springref": "{-0.5:0.5}"},
    "joint_damping_poly": _DAMPING,
    "joint_limit": _LIMIT,
    "joint_limit_solver": _SOLVER,
    "joint_limit_direct": _LIMIT | {"solreflimit": "{-900:-200} {-60:-15}"},
    "actuatorgravcomp": {"actuatorgravcomp": "true", "actuatorfrcrange": "{-0.6:-0.2} {0.2:0.6}"},
    "joint_actuatorfrcrange": {"actuatorfrcrange": "{-0.8:-0.2} {0.2:0.8}"},
    "joint_friction": {"frictionloss": "{0.1:0.4}"},
}
_TENDON: dict[str, dict[str, str]] = {
    "spring": {"stiffness": "{2:5} {-0.5:1} {0:2}", "springlength": "{-0.1:-0.02} {0.02:0.1}"},
    "damping": _DAMPING,
    "limit": _TIGHT,
    "limit_solver": _SOLVER | _TIGHT,
    "armature": {"armature": "{0.02:0.08}"},
    "actuatorfrcrange": {"actuatorfrcrange": "{-0.6:-0.2} {0.2:0.6}"},
    "friction": {"frictionloss": "{0.1:0.3}"},
}
_PD = 'kp="{3:8}" kv="{0.2:0.6}"'
_GENERAL = 'gainprm="{1:2}" biastype="affine" biasprm="{-0.3:0.3} {-2:-1} {-0.3:-0.1}" dynprm="{0.03:0.2}" dyntype='
_MOTOR = 'resistance="{0.8:1.5}" motorconst="{0.3:0.5}"'
_CONTROL = 'controller="{5:9} {2:5} {0.2:0.5} {1:2} {0.05:0.1} {1:2}"'
_HEAT, _BRISTLE = 'thermal="{2:5} {0.1:0.3} 0 {0.004:0.02} 25 20"', 'lugre="{20:60} {0.1:0.4} {0.1:0.3} 0.35 {0.2:0.5}"'
_LAW: dict[str, str] = {
    "motor": "motor",
    "position": f"position {_PD}",
    "position_dampratio": 'position kp="{3:8}" dampratio="{0.4:1}"',
    "position_timeconst": f'position {_PD} timeconst="{{0.02:0.1}}"',
    "velocity": 'velocity kv="{0.4:1}"',
    "intvelocity": f"intvelocity {_PD}",
    "damper": 'damper kv="{0.3:0.8}" ctrlrange="0 2"',
    "cylinder": 'cylinder timeconst="{0.05:0.2}" area="{0.5:1}" bias="{-0.5:0.5} {-1:0} {-0.3:0}"',
    "affine": 'general gaintype="affine" gainprm="{1:2} {-0.5:0.5} {-0.2:0}" biastype="affine" biasprm="0.2 -1 -0.3"',
    "filter": f'general {_GENERAL}"filter"',
    "filterexact": f'general {_GENERAL}"filterexact"',
    "integrator": f'general {_GENERAL}"integrator"',
    "pid": f"pid {_PD}",
    "pid_integral": f'pid {_PD} ki="{{2:6}}" input="pos"',
    "pid_imax": f'pid {_PD} ki="{{2:6}}" imax="{{0.03:0.1}}" input="pos vel ff"',
    "pid_slew": f'pid {_PD} ki="{{2:6}}" slewmax="{{1:3}}" input="pos ff"',
    "pid_feedforward": f'pid {_PD} input="vel ff"',
    "dcmotor": f"dcmotor {_MOTOR}",
    "dcmotor_inductance": f'dcmotor {_MOTOR} inductance="0 {{0.004:0.02}}"',
    "dcmotor_saturation": f'dcmotor {_MOTOR} inductance="{{0.005:0.02}} 0" saturation="{{0.5:1}} 0 {{20:60}}"',
    "dcmotor_cogging": f'dcmotor {_MOTOR} cogging="{{0.1:0.4}} 6 {{-1:1}}"',
    "dcmotor_thermal": f"dcmotor {_MOTOR} {_HEAT}",
    "dcmotor_lugre": f"dcmotor {_MOTOR} {_BRISTLE}",
    "dcmotor_passive": f'dcmotor {_MOTOR} input="none" cogging="{{0.1:0.4}} 5 {{-1:1}}"',
    "dcmotor_controller": f'dcmotor {_MOTOR} input="pos vel ff voltage" {_CONTROL}',
    "dcmotor_everything": f'dcmotor {_MOTOR} input="pos" {_CONTROL} inductance="0 {{0.01:0.02}}" {_HEAT} {_BRISTLE}',
}
_AT = ("joint", "jointinparent", "fixed_tendon", "spatial_tendon", "site", "refsite", "slidercrank")
_STATES = ("filter", "filterexact", "integrator")
_EXTRA: dict[str, tuple[str, tuple[str, ...]]] = {
    "ctrlrange": ("", ("motor", "position", "velocity", "cylinder", "filter", "pid_integral", "dcmotor")),
    "forcerange": ('forcerange="{-0.8:-0.3} {0.3:0.8}"', ("motor", "position", "velocity", "pid", "affine")),
    "actrange": ('actrange="{-0.4:-0.1} {0.1:0.4}"', (*_STATES, "intvelocity")),
    "actearly": ('actearly="true"', _STATES),
    "delay": (
        'nsample="80" delay="{0.005|0.015|0.04}"',
        ("motor", "position", "filter", "pid_slew", "pid", "dcmotor", "velocity"),
    ),
    "actuator_damping": ('damping="{0.05:0.2} {0.02:0.1} {0.02:0.1}"', tuple(_LAW)),
    "actuator_armature": ('armature="{0.01:0.04}"', tuple(_LAW)),
    "gear": ('gear="{0.6:2}"', tuple(_LAW)),
}
"""What an actuator may have, and the laws among which one is looked for to have it."""

FRICTION = ("joint_friction", "fixed_tendon_friction", "spatial_tendon_friction")
FEATURES: tuple[str, ...] = (
    *("branches", "two_joints", "welded_body", "slide", "ref", "gravity_oblique", "gravcomp", *_JOINT),
    *(f"{kind}_tendon_{part}" for kind in ("fixed", "spatial") for part in _TENDON),
    *("joint_equality", "joint_equality_solver", "tendon_equality"),
    *(*_LAW, *(f"at_{place}" for place in _AT), *_EXTRA),
)
"""What ``random_tree`` can draw, named after MJCF; springs of tendons have a dead band, ``at_…`` are transmissions.

Every tree has oblique axes and frames, joints off the body's origin, linear damping, and a linear spring at each slide.
"""
ALL = FEATURES
SMOOTH = tuple(name for name in FEATURES if name not in FRICTION)
"""All without dry friction."""

_OFF: dict[str, str] = {
    "gravcomp": "body_gravcomp", "armature": "dof_armature", "joint_spring": "jnt_stiffness",
    "joint_spring_poly": "jnt_stiffnesspoly", "joint_damping_poly": "dof_dampingpoly", "joint_limit": "jnt_limited",
    "joint_limit_solver": "jnt_limited", "joint_limit_direct": "jnt_limited", "actuatorgravcomp": "jnt_actgravcomp",
    "joint_actuatorfrcrange": "jnt_actfrclimited", "joint_friction": "dof_frictionloss",
    "ctrlrange": "actuator_ctrllimited", "forcerange": "actuator_forcelimited", "actearly": "actuator_actearly",
    "delay": "actuator_delay", "actuator_damping": "actuator_damping", "actuator_armature": "actuator_armature",
}  # fmt: skip
"""Feature → the model's field that is set to zero to see whether the feature acts; of tendons below."""
_TENDON_OFF = {"spring": "stiffnesspoly", "damping": "dampingpoly", "limit": "limited", "limit_solver": "limited",
               "armature": "armature", "actuatorfrcrange": "actfrclimited", "friction": "frictionloss"}  # fmt: skip
_PARTS: dict[str, list[tuple[str, int, float]]] = {
    "pid_imax": [("dynprm", 0, 0.0)], "pid_slew": [("dynprm", 1, 1e9)], "dcmotor_saturation": [("dynprm", 1, 0.0)],
    "dcmotor_cogging": [("biasprm", 0, 0.0)], "dcmotor_thermal": [("gainprm", 2, 0.0)],
    "dcmotor_controller": [("dynprm", 7, 1e9), ("dynprm", 8, 0.0), ("gainprm", 7, 0.0)],
}  # fmt: skip
"""Law → entries of the actuator's parameters without which a part of the law does not act; by default all of it."""

DURATION, GRIDS = 3.0, (0.01, 0.025)
"""For how long trees are looked at, and the intervals at which commands may change [s]."""
STEP = 2.5e-3
"""At which trees are looked at, a divisor of all of ``GRIDS`` and of all delays [s]."""
SHIFT, APART = 1e-9, 1e-8
"""No start shifted by the first comes further apart than the second: trees are not chaotic [rad, m]."""
FURTHEST, FASTEST = 3.0, 20.0
"""How far from ``qpos0`` [rad, m] and how fast [rad/s, m/s] joints of a tree get at most."""
ATTEMPTS, SAMPLES = 80, 60
LEAST = 1e-2
"""A feature acts where q̈ or ȧ differ by this without it [rad/s², m/s², 1/s]."""
LEAST_EIGENVALUE = 0.02
"""Of the mass matrix with its diagonal scaled to one."""
LONGEST = 0.01
"""Step of ``converged``, that no limit is stepped over [s]."""
HARD = 0.9999
"""Impedance of hardened dry friction, the largest there is."""
SPATIAL = int(mujoco.mjtTendon.mjTENDON_SPATIAL)


@contextmanager
def _quietly() -> Iterator[None]:
    """MuJoCo's warnings neither on the screen nor in its log; they are counted where they are read."""
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(previous)


@_quietly()
def random_tree(rng: np.random.Generator, joints: int, features: Collection[str] = ALL) -> str:
    """MJCF of a random fixed-base tree: it moves moderately, and what was drawn acts in its motion.

    Moderately: under random commands for ``DURATION`` no joint gets further than ``FURTHEST`` or becomes faster than
    ``FASTEST``, no start shifted by ``SHIFT`` comes further apart than ``APART``, the mass matrix is well conditioned,
    and no limit chatters. Others are drawn again.

    Args:
        rng: where the numbers come from.
        joints: how many.
        features: of ``FEATURES``, those allowed; a tree has some of them.

    Raises:
        ConfigError: for an unknown feature.
        ModelError: where no such tree was found.
    """
    if unknown := sorted(set(features) - set(FEATURES)):
        raise ConfigError(f"unknown features {', '.join(unknown)}; known are {', '.join(FEATURES)}")
    wanted: set[str] = set()
    for attempt in range(ATTEMPTS):
        if attempt % 8 == 0:
            wanted = _chosen(rng, joints, features)
        xml = _Draw(rng, joints, wanted).xml()
        model = mujoco.MjModel.from_xml_string(xml)
        times, ctrl = controls(rng, model, DURATION)
        try:
            states, moderate = _motion(model, times, ctrl, SHIFT)
        except SimulationDiverged:
            continue
        missing = wanted - _acting(model, states, ctrl) if moderate else set()
        if moderate and not missing and not _chatters(xml, times, ctrl):
            return xml
        if attempt % 3 == 2:
            wanted -= missing
    raise ModelError(f"no tree of {joints} joints was found in {ATTEMPTS} attempts")


def _chosen(rng: np.random.Generator, joints: int, features: Collection[str]) -> set[str]:
    """Some of the features, as many as so many joints can carry; of one joint there are no tendons."""

    def some(names: Collection[str], count: int) -> set[str]:
        allowed = [name for name in FEATURES if name in names and name in features]
        return {str(name) for name in rng.permutation(np.array(allowed, dtype=object))[:count]}

    hard = {name for name in FEATURES if "limit" in name or "equality" in name or "friction" in name}
    plain = set(FEATURES) - hard - set(_LAW) - set(_EXTRA) - {f"at_{place}" for place in _AT}
    chosen = some(plain, int(rng.integers(3, 6 + joints))) | some(hard, int(rng.integers(1, 4 + joints // 2)))
    laws, extras = some(_LAW, 3 + joints // 2), some(_EXTRA, int(rng.integers(1, 4 + joints // 2)))
    for extra in sorted(extras):
        laws |= set() if laws & set(_EXTRA[extra][1]) else some(_EXTRA[extra][1], 1)
    places = some({f"at_{place}" for place in _AT}, int(rng.integers(1, 3 + joints // 2)))
    for limited in [name for name in chosen if name.endswith("_actuatorfrcrange")]:
        place = f"at_{limited.removesuffix('_actuatorfrcrange')}"
        if laws and place in features:
            places.add(place)
        else:
            chosen.remove(limited)
    if laws:
        chosen |= laws | extras | places
    return {n for n in chosen if joints > 1 or not ("tendon" in n or n in ("branches", "two_joints", "joint_equality"))}


class _Draw:
    """The numbers of one tree."""

    def __init__(self, rng: np.random.Generator, joints: int, wanted: set[str]) -> None:
        self.rng, self.wanted = rng, wanted
        self.joints: dict[str, dict[str, str]] = {}
        self.bodies: list[tuple[int, str]] = [(-1, self.sites("b0"))]
        while len(self.joints) < joints:
            self.body(joints)
        for feature, attributes in _JOINT.items():
            if feature in wanted:
                own = self.joints[str(rng.choice(list(self.joints)))]
                own |= {k: self.scaled(k, v, own["type"] == "slide", float(own["ref"])) for k, v in attributes.items()}

    def fill(self, template: str) -> str:
        """The template with its numbers drawn, or chosen among several."""

        def number(found: re.Match[str]) -> str:
            if "|" in found[1]:
                return str(self.rng.choice(found[1].split("|")))
            low, high = sorted(float(word) for word in found[1].split(":"))
            return f"{self.rng.uniform(low, high):.5g}"

        return re.sub(r"\{([^}]*)\}", number, template)

    def scaled(self, name: str, template: str, metres: bool, offset: float = 0.0) -> str:
        """An attribute in SI units: 0.12 m of a slide or of a spatial tendon count as 1 rad, 6 N as 1 N·m."""
        length, force = (0.12, 6.0) if metres else (1.0, 1.0)
        if "sol" in name or template == "true":
            return self.fill(template)
        x = np.array([float(word) for word in self.fill(template).split()])
        if name in ("range", "springlength", "springref", "margin"):
            x = x * length + (0.0 if name == "margin" else offset)
        else:
            x = x * force / length ** np.arange(1, len(x) + 1) ** (name in ("stiffness", "damping", "armature"))
        return " ".join(f"{value:.7g}" for value in x)

    def vector(self, size: float) -> str:
        """Of random direction, half to wholly of this size."""
        v = self.rng.normal(size=3)
        return " ".join(f"{x:.5g}" for x in v / np.linalg.norm(v) * size * self.rng.uniform(0.5, 1.0))

    def sites(self, body: str) -> str:
        """Two sites of a body."""
        return "".join(f'<site name="{body}{i}" pos="{self.vector(0.15)}" euler="{self.vector(2)}"/>' for i in "xy")

    def mass(self) -> str:
        """Of a solid ellipsoid, by its principal axes or as a full matrix."""
        mass, axes = self.rng.uniform(0.4, 1.0), self.rng.uniform(0.1, 0.2, 3)
        moments = mass / 5 * (np.sum(axes**2) - axes**2)
        text = f'<inertial pos="{self.vector(0.12)}" mass="{mass:.4g}" '
        if self.rng.random() < 0.5:
            return text + f'euler="{self.vector(2)}" diaginertia="{_words(moments)}"/>'
        turn, _ = np.linalg.qr(self.rng.normal(size=(3, 3)))
        return text + f'fullinertia="{_words(((turn * moments) @ turn.T)[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)])}"/>'

    def body(self, joints: int) -> None:
        """One more body, of one or two joints, perhaps with another welded to it."""
        index, u, wanted = len(self.bodies), self.rng.random, self.wanted
        parent = int(self.rng.integers(0, index)) if "branches" in wanted else index - 1
        frame = f'pos="{self.vector(0.25)}" euler="{self.vector(2)}"'
        lift = self.fill(' gravcomp="{0.2:1}"') if wanted & {"gravcomp", "actuatorgravcomp"} else ""
        text = f"<body {frame}{lift}>"
        for _ in range(min(1 + ("two_joints" in wanted and u() < 0.8), joints - len(self.joints))):
            name, slide = f"j{len(self.joints)}", "slide" in wanted and u() < 0.5
            ref = f"{self.rng.uniform(-0.5, 0.5) * (0.1 if slide else 1):.4g}" if "ref" in wanted else "0"
            own = {"type": "slide" if slide else "hinge", "ref": ref, "axis": self.vector(1), "pos": self.vector(0.05)}
            self.joints[name] = own | {"damping": self.scaled("damping", "{0.1:0.3}", slide)}
            if slide:
                self.joints[name] |= {"stiffness": self.fill("{100:250}"), "springref": ref}
            text += f"<{name}/>"
        text += self.mass() + self.sites(f"b{index}")
        if "welded_body" in wanted and u() < 0.8:
            text += f'<body pos="{self.vector(0.15)}" euler="{self.vector(2)}"{lift}>{self.mass()}</body>'
        self.bodies.append((parent, text))

    def world(self) -> str:
        """The bodies, each within its parent."""
        text = [body for _, body in self.bodies]
        for index in range(len(text) - 1, 0, -1):
            text[self.bodies[index][0]] += text[index] + "</body>"
        return re.sub(r"<(j\d+)/>", lambda m: f'<joint name="{m[1]}" {_attributes(self.joints[m[1]])}/>', text[0])

    def path(self, count: int) -> list[str]:
        """Sites of bodies that differ."""
        bodies = self.rng.choice(len(self.bodies), min(count, len(self.bodies)), replace=False)
        return [f"b{body}{self.rng.choice(['x', 'y'])}" for body in bodies]

    def place(self, place: str, tendons: dict[str, dict[str, str]]) -> str:
        """Attributes of a transmission; lengths in metres are geared up to compare with angles."""
        gear = self.fill("{0.6:2}") if "gear" in self.wanted else "1"
        geared = f'gear="{4 * float(gear):.5g}"'
        a, b = self.path(2)
        if "joint" in place:
            name = str(self.rng.choice(list(self.joints)))
            return f'{place}="{name}" ' + (geared if self.joints[name]["type"] == "slide" else f'gear="{gear}"')
        if "tendon" in place:
            names = [name for name in tendons if place.startswith(name[:-1])]
            name = str(self.rng.choice([name for name in names if "actuatorfrcrange" in tendons[name]] or names))
            return f'tendon="{name}" ' + (geared if name[0] == "s" else f'gear="{gear}"')
        if place == "slidercrank":
            return self.fill(f'cranksite="{a}" slidersite="{b}" cranklength="{{0.8:1.2}}" {geared}')
        if place == "site":
            return f'site="{a}" gear="{self.vector(3)} {self.vector(0.5)}"'
        axes = f"{self.vector(4)} 0 0 0" if self.rng.random() < 0.6 else f"0 0 0 {self.vector(1)}"
        return f'site="{a}" refsite="{b}" gear="{axes}"'

    def xml(self) -> str:
        """The whole robot: compiled once with bare tendons and motors, for their lengths, then written in full."""
        rng, wanted = self.rng, self.wanted
        gravity = _words(rng.normal(size=3) * 5) if "gravity_oblique" in wanted else "0 0 -9.81"
        head = f'<option timestep="0.001" integrator="RK4" gravity="{gravity}"><flag contact="disable"/></option>'
        head += f'<compiler angle="radian"/><worldbody>{self.world()}</worldbody>'
        tendons: dict[str, dict[str, str]] = {}
        for kind in ("fixed", "spatial"):
            parts = [part for part in _TENDON if f"{kind}_tendon_{part}" in wanted]
            also = f"at_{kind}_tendon" in wanted or (kind == "fixed" and "tendon_equality" in wanted)
            for i in range(bool(parts or also) + (len(parts) > 2)):
                some = parts[i::2] if len(parts) > 2 else parts
                tendons[f"{kind}{i}"] = {k: v for part in some for k, v in _TENDON[part].items()}
        path = {name: self.tendon(name[0] == "s") for name in tendons}
        laws = [str(law) for law in rng.permutation([name for name in _LAW if name in wanted])]
        places = [place for place in _AT if f"at_{place}" in wanted] or ["joint"]
        drives: dict[str, str] = {}
        for i in range(max(len(laws), len(places)) if laws else 0):
            place = places[i] if i < len(places) else str(rng.choice(places))
            drives[f"{laws[i % len(laws)]}:{place}:{i}"] = self.place(place, tendons)

        def text(tendons: dict[str, dict[str, str]], drives: dict[str, str], rest: str = "") -> str:
            strings = [f'<{n[:-1]} name="{n}" {_attributes(own)}>{path[n]}</{n[:-1]}>' for n, own in tendons.items()]
            acts = [f"<{own.replace(' ', f' name={chr(34)}{n}{chr(34)} ', 1)}/>" for n, own in drives.items()]
            return (
                f"<mujoco>{head}<tendon>{''.join(strings)}</tendon><actuator>{''.join(acts)}</actuator>{rest}</mujoco>"
            )

        motors = {name: f"motor {place}" for name, place in drives.items()}
        bare = mujoco.MjModel.from_xml_string(text({name: {} for name in tendons}, motors))
        for name, own in tendons.items():
            length = float(bare.tendon_length0[bare.tendon(name).id])
            tendons[name] = {k: self.scaled(k, v, name[0] == "s" and "frc" not in k, length) for k, v in own.items()}
            if name[0] == "s" and rng.random() < 0.7 and "range" in own:
                tendons[name]["range"] = "0 " + tendons[name]["range"].split()[1]
        for name in drives:
            drives[name] = self.fill(_LAW[name.split(":")[0]]) + " " + drives[name]
        for extra in (name for name in _EXTRA if name in wanted and name != "gear"):
            on = {"joint", "jointinparent", "fixed_tendon", "spatial_tendon"} if "actuator_" in extra else set(_AT)
            fit = [n for n in drives if n.split(":")[0] in _EXTRA[extra][1] and n.split(":")[1] in on]
            if fit:
                name = str(rng.choice(fit))
                zero = bare.actuator_length0[bare.actuator(name).id] if name.startswith(("position", "pid")) else 0.0
                drives[name] += " " + self.fill(_EXTRA[extra][0] or f'ctrlrange="{zero - 0.5:.5g} {zero + 0.4:.5g}"')
        return text(tendons, drives, f"<equality>{self.equalities(tendons)}</equality>")

    def tendon(self, spatial: bool) -> str:
        """The path of a tendon: two or three sites, or two joints."""
        if spatial:
            return "".join(f'<site site="{site}"/>' for site in self.path(int(self.rng.integers(2, 4))))
        names = [str(name) for name in self.rng.choice(list(self.joints), 2, replace=False)]
        sizes = [(8 if self.joints[name]["type"] == "slide" else 1) * self.rng.choice([-1, 1]) for name in names]
        pairs = zip(names, sizes, strict=True)
        return "".join(self.fill(f'<joint joint="{n}" coef="{{{s / 2}:{1.5 * s}}}"/>') for n, s in pairs)

    def equalities(self, tendons: Collection[str]) -> str:
        """Polynomial couplings of joints and of tendons."""
        own, text = self.fill(f'solref="{_OWN[0]}" solimp="{_OWN[1]}"'), ""
        for feature in ("joint_equality", "joint_equality_solver", "tendon_equality"):
            if feature not in self.wanted:
                continue
            kind = feature.split("_")[0]
            names = [str(name) for name in self.rng.permutation(list(self.joints))]
            units = [0.12 if self.joints[name]["type"] == "slide" else 1.0 for name in names]
            if kind == "tendon":
                names, units = [name for name in tendons if name[0] == "f"], [1.0, 1.0]
            both = len(names) > 1 and self.rng.random() < 0.8
            drawn = self.fill("{-0.1:0.1} {0.4:1} {-0.3:0.3} {-0.2:0.2} {-0.1:0.1}")
            c = (
                np.array([float(word) for word in drawn.split()])
                * units[0]
                / (units[1] if both else 1.0) ** np.arange(5)
            )
            second, solver = f'{kind}2="{names[1]}"' if both else "", own if "solver" in feature else ""
            text += f'<{kind} {kind}1="{names[0]}" {second} polycoef="{_words(c)}" {solver}/>'
        return text


def _words(values: Any) -> str:
    return " ".join(f"{x:.7g}" for x in values)


def _attributes(values: dict[str, str]) -> str:
    return " ".join(f'{name}="{value}"' for name, value in values.items())


def controls(rng: np.random.Generator, model: Any, duration: float) -> tuple[Array, Array]:
    """Random commands, each held for 0.1 to 0.5 s: times (n,) [s] on a grid of ``GRIDS``, commands (n, nu).

    Positions are commanded about the actuators' lengths at ``qpos0``; ranges are exceeded by a third.
    """
    grid = float(rng.choice(GRIDS))
    times = np.arange(round(duration / grid)) * grid
    low, high = np.empty(model.nu), np.empty(model.nu)
    sizes = {1: 0.6, 2: 2.0, 4: 1.0, 8: 4.0, 32: 2.0, 0: 1.5}
    for i in range(model.nactuator):
        kinds = [bit for bit in (1, 2, 4, 8, 32) if int(model.actuator_ctrlspec[i]) & bit] or [0]
        for k, kind in enumerate(kinds[: model.actuator_ctrlnum[i]], start=int(model.actuator_ctrladr[i])):
            middle, spread = float(model.actuator_length0[i]) if kind == 1 else 0.0, sizes[kind]
            if model.actuator_ctrllimited[k]:
                middle, spread = np.mean(model.actuator_ctrlrange[k]), np.ptp(model.actuator_ctrlrange[k]) * 2 / 3
            low[k], high[k] = middle - spread, middle + spread
    ctrl = np.empty((len(times), model.nu))
    row = 0
    while row < len(times):
        held = round(rng.uniform(0.1, 0.5) / grid)
        ctrl[row : row + held] = rng.uniform(low, high)
        row += held
    return np.asarray(times, dtype=np.float64), ctrl


@_quietly()
def acting(xml: str, times: Array, ctrl: Array) -> frozenset[str]:
    """Those of ``FEATURES`` that change q̈ or ȧ somewhere along the motion under commands (n, nu) at times (n,) [s].

    Raises:
        SimulationDiverged: where MuJoCo warns.
    """
    model = mujoco.MjModel.from_xml_string(xml)
    return frozenset(_acting(model, _motion(model, times, ctrl, 0.0)[0], ctrl))


def _motion(model: Any, times: Array, ctrl: Array, shift: float) -> tuple[Array, bool]:
    """(n, size of the state) at the commands' times, and whether the motion is moderate, see ``random_tree``."""
    data, full = mujoco.MjData(model), mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.empty((2, mujoco.mj_stateSize(model, full)))
    for row in start:
        mujoco.mj_getState(model, data, row, full)
        data.qpos[:] += shift * np.cos(np.arange(model.nq))
    grid = round((times[1] - times[0]) / STEP)
    states = _rolled(model, data, start, np.repeat(ctrl, grid, axis=0))
    if data.warning.number.any():
        raise SimulationDiverged(f"MuJoCo's motion diverges at a step of {STEP} s")
    q, v = states[:, :, 1 : 1 + model.nq], states[:, :, 1 + model.nq : 1 + 2 * model.nq]
    moderate = (
        np.abs(q - model.qpos0).max() < FURTHEST and np.abs(v).max() < FASTEST and np.abs(q[1] - q[0]).max() < APART
    )
    states = np.concatenate([start[:1], states[0, grid - 1 : -1 : grid]])
    return states, bool(moderate) and all(_sound(model, state) for state in states[::20])


def _sound(model: Any, state: Array) -> bool:
    """Whether the mass matrix, its diagonal scaled to one, is well conditioned.

    MuJoCo drops the coupling of different branches by a tendon's armature: what is left need not be positive definite.
    """
    data, mass = mujoco.MjData(model), np.empty((model.nv, model.nv))
    mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    scale = np.sqrt(np.maximum(np.diag(mass), 1e-12))
    return bool(np.linalg.eigvalsh(mass / np.outer(scale, scale))[0] > LEAST_EIGENVALUE)


def _chatters(xml: str, times: Array, ctrl: Array) -> bool:
    """Whether a spatial tendon chatters at its limit, whose law has no J̇v: no integrator gets far beyond that."""
    model, delays = _tightened(xml)
    if not (model.tendon_limited.astype(bool) & (model.tendon_type == SPATIAL)).any():
        return False
    try:
        _limit(model, times, ctrl, delays, np.array([0.0, times[-1]]), 1e-6, 1500)
    except SimulationDiverged:
        return True
    return False


def _rolled(model: Any, data: Any, start: Array, ctrl: Array) -> Array:
    """(k, n, size of the state) after each step of commands (n, nu), from each start (k, size)."""
    given = ctrl[None].repeat(len(start), 0) if model.nu else None
    return np.array(rollout(model, data, start, given, nstep=len(ctrl))[0])


def _acting(model: Any, states: Array, ctrl: Array) -> set[str]:
    """As ``acting``: each feature is taken out of a copy of the model, to see whether ``SAMPLES`` states miss it."""
    rows = np.linspace(0, len(states) - 1, SAMPLES).astype(int)

    def rates(own: Any) -> tuple[Array, Array]:
        data, found, act = mujoco.MjData(own), np.empty((SAMPLES, own.nv + own.na)), np.empty((SAMPLES, own.na))
        for k, row in enumerate(rows):
            mujoco.mj_setState(own, data, states[row], mujoco.mjtState.mjSTATE_FULLPHYSICS)
            data.ctrl[:] = ctrl[row]
            mujoco.mj_forward(own, data)
            found[k], act[k] = np.concatenate([data.qacc, data.act_dot]), data.act
        return found, act

    whole, act = rates(model)
    structure = {
        "branches": len(set(model.body_parentid[1:])) < model.nbody - 1,
        "two_joints": (model.body_jntnum > 1).any(),
        "welded_body": (model.body_jntnum[1:] == 0).any(),
        "slide": (model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE).any(),
        "ref": model.qpos0.any(),
        "gravity_oblique": model.opt.gravity[:2].any(),
        "gear": (np.abs(model.actuator_gear[:, 0]) % 1).any(),
    }
    seen = {name for name, there in structure.items() if there}
    for i in np.flatnonzero(model.actuator_actlimited):
        if np.isin(act[:, model.actuator_actadr[i]], model.actuator_actrange[i]).any():
            seen.add("actrange")
    for feature in set(FEATURES) - set(structure) - {"actrange"}:
        least = 1e-8 if feature == "actearly" else LEAST
        copies = _without(model, feature)
        if copies and all(np.abs(rates(own)[0] - whole).max() > least for own in copies):
            seen.add(feature)
    return seen


def _without(model: Any, feature: str) -> list[Any]:
    """Copies of the model without a feature, or without one part of it each; none where the model has it not."""
    if feature in _LAW or feature.startswith("at_"):
        names = [model.actuator(i).name.split(":")[:2] for i in range(model.nactuator)]
        on = [i for i, name in enumerate(names) if feature.removeprefix("at_") in name]
        copies = [copy(model) for _ in (_PARTS.get(feature, [None]) if on else [])]
        for own, part in zip(copies, _PARTS.get(feature, []), strict=False):
            getattr(own, f"actuator_{part[0]}")[on, part[1]] = part[2]
        for own in copies if feature not in _PARTS else []:
            own.actuator_group[on], own.opt.disableactuator = 30, 1 << 30
        return copies
    kind, tendon, name = feature.partition("_tendon_")
    field, where = _OFF.get(feature, ""), np.array(True)
    if tendon:
        field = f"tendon_{_TENDON_OFF[name]}"
        where = (model.tendon_type == SPATIAL) == (kind == "spatial")
    elif feature == "joint_spring":
        where = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    elif "equality" in feature:
        joint = mujoco.mjtEq.mjEQ_JOINT if feature.startswith("joint") else mujoco.mjtEq.mjEQ_TENDON
        field, where = "eq_active0", (model.eq_type == joint)
    if not field:
        return []
    if "limit" in feature or "equality" in feature:
        ref = model.eq_solref if field[0] == "e" else model.tendon_solref_lim if tendon else model.jnt_solref
        style = np.where(ref[:, 0] < 0, "direct", np.where((ref == (0.02, 1)).all(1), "", "solver"))
        where = where & (style == (feature.split("_")[-1] if feature.endswith(("direct", "solver")) else ""))
    own = copy(model)
    values = getattr(own, field)
    chosen = np.broadcast_to(where.reshape(-1, *[1] * (values.ndim - 1)) if where.ndim else where, values.shape)
    found = bool(values[chosen].any())
    values[chosen] = 0
    return [own] if found else []


def _tightened(xml: str) -> tuple[Any, Array]:
    """The model with an exact constraint solver and without ``refsafe``, and the delays [s] (nu,) taken out of it."""
    model = mujoco.MjModel.from_xml_string(xml)
    if (model.jnt_type < int(mujoco.mjtJoint.mjJNT_SLIDE)).any() or (model.actuator_history[:, 1] != 0).any():
        raise ModelError("only hinges and slides, and delays without interpolation, have a reference")
    model.opt.integrator, model.opt.solver = mujoco.mjtIntegrator.mjINT_RK4, mujoco.mjtSolver.mjSOL_NEWTON
    model.opt.tolerance, model.opt.ls_tolerance, model.opt.iterations, model.opt.ls_iterations = 1e-20, 1e-12, 100, 100
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_REFSAFE
    delays = np.repeat(model.actuator_delay, model.actuator_ctrlnum)
    model.actuator_delay[:] = 0.0
    return model, delays


def _given(times: Array, ctrl: Array, delays: Array, at: Array) -> Array:
    """(len(at), nu) the commands that hold from each time [s] on; nothing is commanded before the first arrives."""
    row = np.searchsorted(times, at[:, None] - delays + 1e-9) - 1
    return np.where(row >= 0, np.take_along_axis(ctrl, np.maximum(row, 0), axis=0), 0.0)


def hardened(model: Any, rate: float) -> Any:
    """A copy in which dry friction brings its joint or tendon to rest at this rate [1/s], and hardly lets it creep.

    MuJoCo's own does so at 100/s, with impedance 0.9. What remains goes with 1/rate: friction turns about 1/rate late
    where a joint reverses, and a joint at rest under a load creeps at 1e-4 of the acceleration held back over the rate.
    Explicit methods need steps below 2/rate.
    """
    own = copy(model)
    for ref, imp in ((own.dof_solref, own.dof_solimp), (own.tendon_solref_fri, own.tendon_solimp_fri)):
        ref[:] = -1.0, -rate
        imp[:] = HARD, HARD, 1e-3, 0.5, 2.0
    return own


def _rubs(model: Any) -> bool:
    return bool(model.dof_frictionloss.any() or model.tendon_frictionloss.any())


@_quietly()
def reference(xml: str, times: Array, ctrl: Array, duration: float, step: float) -> Array:
    """Joint positions (m, nq) by ``mj_step`` with RK4, from rest at ``qpos0``, at the commands' times and the end.

    Delays are taken exactly, as commands that come later; dry friction is ``hardened`` to the rate 1/step.

    Args:
        xml: the tree.
        times: (n,) of the commands, from 0 [s].
        ctrl: (n, nu) commands, each held until the next.
        duration: of the motion [s].
        step: of which all times, delays and the duration are whole multiples [s].

    Raises:
        ConfigError: where the step does not divide a time.
        SimulationDiverged: where MuJoCo warns.
    """
    model, delays = _tightened(xml)
    at = np.append(times[times < duration - 1e-9], duration)
    if (wrong := np.abs(np.remainder(np.append(at, delays) / step + 0.5, 1) - 0.5) > 1e-6).any():
        raise ConfigError(f"the step {step} s does not divide {np.append(at, delays)[wrong][0]} s")
    model = hardened(model, 1 / step) if _rubs(model) else model
    model.opt.timestep = step
    data, rows = mujoco.MjData(model), np.round(at / step).astype(int)
    start = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    given = _given(times, ctrl, delays, np.arange(rows[-1]) * step)
    states = _rolled(model, data, start[None], given)[0]
    if data.warning.number.any() or not np.isfinite(states).all():
        raise SimulationDiverged(f"MuJoCo's motion diverges at a step of {step} s")
    return np.concatenate([model.qpos0[None], states[rows[1:] - 1, 1 : 1 + model.nq]])


@dataclass(frozen=True, eq=False)
class Converged:
    """What MuJoCo's motion tends to as its step tends to zero.

    Attributes:
        times: (m,) of the commands, and the end [s].
        q: (m, nq) joint positions [rad, m].
        tolerance: of the integrator's error in each step.
        rate: the highest of hardened dry friction [1/s]; infinite without any.
        change: how much the last refinement moved any position: of the tolerance by ten, of the rate by two [rad, m].
    """

    times: Array
    q: Array
    tolerance: float
    rate: float
    change: float


@_quietly()
def converged(xml: str, times: Array, ctrl: Array, duration: float, target: float | None = None) -> Converged:
    """Refine the motion until that changes it by less than the target: 1e-8, with dry friction 1e-6 [rad, m].

    The error of hardened friction goes with 1/rate, and positions are extrapolated to 1/rate = 0. After six refinements
    the result is what it is, as its ``change`` tells.

    Args: as of ``reference``.

    Raises:
        SimulationDiverged: where the motion cannot be followed.
    """
    model, delays = _tightened(xml)
    at = np.append(times[times < duration - 1e-9], duration)
    rubs, last, before = _rubs(model), None, None
    for k in range(6):
        tolerance, rate = (1e-10, 2e3 * 2**k) if rubs else (10.0 ** -(7 + k), np.inf)
        found = _limit(hardened(model, rate) if rubs else copy(model), times, ctrl, delays, at, tolerance)
        q = found if last is None or not rubs else 2 * found - last
        change = np.inf if before is None else float(np.abs(q - before).max())
        if change < (target or (1e-6 if rubs else 1e-8)):
            break
        before, last = q, found
    return Converged(at, q, tolerance, rate, change)


def _limit(
    model: Any, times: Array, ctrl: Array, delays: Array, at: Array, tolerance: float, steps: int = 60_000
) -> Array:
    """Positions (m, nq): q̈ and ȧ of ``mj_forward`` integrated between the times at which a command changes.

    Activations are projected on their ranges, and set points of limited slew move as they do under held commands.
    """
    model.opt.timestep = 1e-12
    data, n = mujoco.MjData(model), model.nv
    low, high = np.full(model.na, -np.inf), np.full(model.na, np.inf)
    slews: list[tuple[int, int, float]] = []
    for i in np.flatnonzero(model.actuator_actnum):
        first, dyn, prm = model.actuator_actadr[i], int(model.actuator_dyntype[i]), model.actuator_dynprm[i]
        motor = dyn == int(mujoco.mjtDyn.mjDYN_DCMOTOR)
        if motor or dyn == int(mujoco.mjtDyn.mjDYN_PID):
            slew, most = (prm[7], prm[8]) if motor else (prm[1], prm[0])
            if slew > 0:
                slews.append((first, model.actuator_ctrladr[i], slew))
            if most > 0 and model.actuator_gainprm[i, 5 if motor else 0] > 0:
                low[first + (slew > 0)], high[first + (slew > 0)] = -most, most
        elif model.actuator_actlimited[i]:
            low[first], high[first] = model.actuator_actrange[i]

    led = np.isin(np.arange(model.na), [state for state, _, _ in slews])

    def rates(t: float, y: Array) -> Array:
        data.qpos[:], data.qvel[:], data.act[:], data.ctrl[:] = (
            y[:n],
            y[n : 2 * n],
            np.clip(y[2 * n :], low, high),
            given,
        )
        for (state, control, slew), (begun, aim) in zip(slews, aims, strict=True):
            data.act[state] = data.ctrl[control] = begun + np.clip(aim - begun, -slew * (t - since), slew * (t - since))
        mujoco.mj_forward(model, data)
        held = led | (y[2 * n :] >= high) & (data.act_dot > 0) | (y[2 * n :] <= low) & (data.act_dot < 0)
        return np.concatenate([y[n : 2 * n], data.qacc, np.where(held, 0.0, data.act_dot)])

    edges = np.unique(np.round(np.concatenate([at, *(times + delay for delay in {0.0, *delays})]), 9))
    edges = edges[edges <= at[-1] + 1e-9]
    y, q, step = np.concatenate([data.qpos, data.qvel, np.clip(data.act, low, high)]), [model.qpos0.copy()], 1e-3
    for since, until in pairwise(edges):
        given = _given(times, ctrl, delays, np.array([since]))[0]
        limit = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-np.inf, np.inf])
        aims = [(y[2 * n + state], float(np.clip(given[control], *limit[control]))) for state, control, _ in slews]
        first = min(step, until - since)
        solver = DOP853(rates, since, y, until, LONGEST, tolerance, tolerance, first_step=first)
        while solver.status == "running" and steps > 0:
            solver.step()
            steps -= 1
        if solver.status != "finished":
            raise SimulationDiverged(
                f"from {solver.t:.6f} s on the motion cannot be followed; perhaps a limit chatters"
            )
        step, y = max(solver.h_abs, 1e-6), solver.y.copy()
        y[2 * n :] = np.clip(y[2 * n :], low, high)
        for (state, _, slew), (begun, aim) in zip(slews, aims, strict=True):
            y[2 * n + state] = begun + np.clip(aim - begun, -slew * (until - since), slew * (until - since))
        if np.abs(at - until).min() < 1e-8:
            q.append(y[:n].copy())
    return np.array(q)
