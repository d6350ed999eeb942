"""Random MuJoCo trees of hinges and slides whose features act in their motion, and commands for them."""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.errors import ConfigError, ModelError, SimulationDiverged
from equimus_ctrl.quiet import quietly
from equimus_ctrl.types import Array
from equimus_ctrl.validation.converged import (
    Converged,
    converged,
    hardened,
    limit_of,
    reference,
    rolled,
    tightened,
)
from equimus_ctrl.validation.tree_features import (
    ALL,
    AT,
    EXTRA,
    FEATURES,
    FRICTION,
    JOINT,
    LAW,
    OWN,
    SMOOTH,
    SPATIAL,
    TENDON,
    acting_in,
)

__all__ = [
    "ALL",
    "FEATURES",
    "FRICTION",
    "SMOOTH",
    "Converged",
    "acting",
    "controls",
    "converged",
    "hardened",
    "random_tree",
    "reference",
]

DURATION, GRIDS = 3.0, (0.01, 0.025)
"""For how long trees are looked at, and the intervals at which commands may change [s]."""
STEP = 2.5e-3
"""At which trees are looked at, a divisor of all of ``GRIDS`` and of all delays [s]."""
SHIFT, MOST_SPREAD = 1e-9, 1e-8
"""A start shifted by the first diverges by less than the second: trees are not chaotic [rad, m]."""
FURTHEST, FASTEST = 3.0, 20.0
"""How far from ``qpos0`` [rad, m] and how fast [rad/s, m/s] joints of a tree get at most."""
ATTEMPTS = 80
LEAST_EIGENVALUE = 0.02
"""Of the mass matrix with its diagonal scaled to one."""


@quietly()
def random_tree(rng: np.random.Generator, joints: int, features: Collection[str] = ALL) -> str:
    """MJCF of a random fixed-base tree: it moves moderately, and what was drawn acts in its motion.

    Moderately: under random commands for ``DURATION`` no joint gets further than ``FURTHEST`` or becomes faster than
    ``FASTEST``, no start shifted by ``SHIFT`` diverges by more than ``MOST_SPREAD``, the mass matrix is well
    conditioned, and no limit chatters. Others are drawn again.

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
        missing = wanted - acting_in(model, states, ctrl) if moderate else set()
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
    plain = set(FEATURES) - hard - set(LAW) - set(EXTRA) - {f"at_{place}" for place in AT}
    chosen = some(plain, int(rng.integers(3, 6 + joints))) | some(hard, int(rng.integers(1, 4 + joints // 2)))
    laws, extras = some(LAW, 3 + joints // 2), some(EXTRA, int(rng.integers(1, 4 + joints // 2)))
    for extra in sorted(extras):
        laws |= set() if laws & set(EXTRA[extra][1]) else some(EXTRA[extra][1], 1)
    places = some({f"at_{place}" for place in AT}, int(rng.integers(1, 3 + joints // 2)))
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
        for feature, attributes in JOINT.items():
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
            parts = [part for part in TENDON if f"{kind}_tendon_{part}" in wanted]
            also = f"at_{kind}_tendon" in wanted or (kind == "fixed" and "tendon_equality" in wanted)
            for i in range(bool(parts or also) + (len(parts) > 2)):
                some = parts[i::2] if len(parts) > 2 else parts
                tendons[f"{kind}{i}"] = {k: v for part in some for k, v in TENDON[part].items()}
        path = {name: self.tendon(name[0] == "s") for name in tendons}
        laws = [str(law) for law in rng.permutation([name for name in LAW if name in wanted])]
        places = [place for place in AT if f"at_{place}" in wanted] or ["joint"]
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
            drives[name] = self.fill(LAW[name.split(":")[0]]) + " " + drives[name]
        for extra in (name for name in EXTRA if name in wanted and name != "gear"):
            on = {"joint", "jointinparent", "fixed_tendon", "spatial_tendon"} if "actuator_" in extra else set(AT)
            fit = [n for n in drives if n.split(":")[0] in EXTRA[extra][1] and n.split(":")[1] in on]
            if fit:
                name = str(rng.choice(fit))
                zero = bare.actuator_length0[bare.actuator(name).id] if name.startswith(("position", "pid")) else 0.0
                drives[name] += " " + self.fill(EXTRA[extra][0] or f'ctrlrange="{zero - 0.5:.5g} {zero + 0.4:.5g}"')
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
        own, text = self.fill(f'solref="{OWN[0]}" solimp="{OWN[1]}"'), ""
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


@quietly()
def acting(xml: str, times: Array, ctrl: Array) -> frozenset[str]:
    """Those of ``FEATURES`` that change q̈ or ȧ somewhere along the motion under commands (n, nu) at times (n,) [s].

    Raises:
        SimulationDiverged: where MuJoCo warns.
    """
    model = mujoco.MjModel.from_xml_string(xml)
    return frozenset(acting_in(model, _motion(model, times, ctrl, 0.0)[0], ctrl))


def _motion(model: Any, times: Array, ctrl: Array, shift: float) -> tuple[Array, bool]:
    """(n, size of the state) at the commands' times, and whether the motion is moderate, see ``random_tree``."""
    data, full = mujoco.MjData(model), mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.empty((2, mujoco.mj_stateSize(model, full)))
    for row in start:
        mujoco.mj_getState(model, data, row, full)
        data.qpos[:] += shift * np.cos(np.arange(model.nq))
    grid = round((times[1] - times[0]) / STEP)
    states = rolled(model, data, start, np.repeat(ctrl, grid, axis=0))
    if data.warning.number.any():
        raise SimulationDiverged(f"MuJoCo's motion diverges at a step of {STEP} s")
    q, v = states[:, :, 1 : 1 + model.nq], states[:, :, 1 + model.nq : 1 + 2 * model.nq]
    moderate = (
        np.abs(q - model.qpos0).max() < FURTHEST
        and np.abs(v).max() < FASTEST
        and np.abs(q[1] - q[0]).max() < MOST_SPREAD
    )
    states = np.concatenate([start[:1], states[0, grid - 1 : -1 : grid]])
    return states, bool(moderate) and all(_sound(model, state) for state in states[::20])


def _sound(model: Any, state: Array) -> bool:
    """Whether the mass matrix, its diagonal scaled to one, is well conditioned.

    MuJoCo drops the coupling of different branches by a tendon's armature: the remaining matrix need not be positive
    definite.
    """
    data, mass = mujoco.MjData(model), np.empty((model.nv, model.nv))
    mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    scale = np.sqrt(np.maximum(np.diag(mass), 1e-12))
    return bool(np.linalg.eigvalsh(mass / np.outer(scale, scale))[0] > LEAST_EIGENVALUE)


def _chatters(xml: str, times: Array, ctrl: Array) -> bool:
    """Whether a spatial tendon chatters at its limit, whose law has no J̇v: no integrator gets far beyond that."""
    model, delays = tightened(xml)
    if not (model.tendon_limited.astype(bool) & (model.tendon_type == SPATIAL)).any():
        return False
    try:
        limit_of(model, times, ctrl, delays, np.array([0.0, times[-1]]), 1e-6, 1500)
    except SimulationDiverged:
        return True
    return False
