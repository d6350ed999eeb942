"""A ball on a plate before a robot, whatever the robot was described by."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
from scipy.optimize import brentq

from equimus_ctrl.errors import ModelError, unknown_name

BALL, PLATE, TOUCH = "ball", "plate", "ball touch"
"""What the ball's body, joint and geom, the plate's geom, and the sensor of their force [N] are called."""
IMPEDANCE = (0.95, 0.95, 0.001, 0.5, 2.0)
"""Of the contact that kicks, constant, so that the ball is a spring and a damper."""
THICK = 0.005
"""Of the plate [m]; where it is seen to end is of no consequence."""
WIDE = 0.06
LEAST_RESTITUTION = 0.15
"""A spring and a damper that do not pull give back e⁻² = 0.14 of the speed and more."""


@dataclass(frozen=True)
class Ball:
    """A ball, and how it is touched.

    Attributes:
        radius: [m].
        mass: [kg].
        contact_time: how long it stays at a wall that it is thrown against [s].
        restitution: speed with which it comes back from there, over that with which it came.
        friction: sliding, on the plate and at what kicks it.

    Raises:
        ModelError: for a number that cannot be.
    """

    radius: float = 0.05
    mass: float = 0.1
    contact_time: float = 0.02
    restitution: float = 0.7
    friction: float = 0.5

    def __post_init__(self) -> None:
        for key in ("radius", "mass", "contact_time"):
            if not 0 < getattr(self, key) < math.inf:
                raise ModelError(f"ball: {key} is {getattr(self, key):g}, expected more than 0")
        if not LEAST_RESTITUTION <= self.restitution < 1:
            raise ModelError(f"ball: restitution is {self.restitution:g}, expected {LEAST_RESTITUTION:g} to below 1")
        if not 0 <= self.friction < math.inf:
            raise ModelError(f"ball: friction is {self.friction:g}, expected at least 0")

    @property
    def solref(self) -> tuple[float, float]:
        """MuJoCo's time constant [s] and damping ratio of the contact.

        A mass that meets a spring and a damper of ratio ζ = sin ψ leaves where these would begin to pull: after
        (π − 2ψ)/(ω cos ψ), with exp(−(π − 2ψ) tan ψ) of its speed. MuJoCo's time constant is 1/(ωζ).
        """
        lost = -math.log(self.restitution)
        psi = float(brentq(lambda own: (math.pi - 2 * own) * math.tan(own) - lost, 0.0, math.pi / 2 - 1e-6))
        omega = (math.pi - 2 * psi) / (self.contact_time * math.cos(psi))
        return 1 / (omega * math.sin(psi)), math.sin(psi)


def add_ball(spec: Any, place: Sequence[float], kicker: str, ball: Ball | None = None) -> Any:
    """Put a ball on a plate into any MjSpec; of the robot, the body that kicks may touch it, and nothing else.

    The plate is level as far as gravity along the room's z goes, endless, and touches the ball alone. Free joint, body
    and geom are called ``ball``; the sensor ``ball touch`` tells the force [N] of the body that kicks, in the room.

    Args:
        spec: changed in place.
        place: (3,) where the ball's centre is [m].
        kicker: a site, or a body, whose body's geoms touch the ball.
        ball: the usual one by default.

    Returns:
        The ball's body.

    Raises:
        ModelError: where there is no such site or body, it has no geom, or the model has something of these names.
    """
    ball = ball or Ball()
    for kind, names in (("body", spec.bodies), ("geom", spec.geoms), ("joint", spec.joints)):
        if any(own.name in (BALL, PLATE) for own in names):
            raise ModelError(f"a ball is added to a robot without one, but a {kind} of this has its name")
    body = _body_of(spec, kicker)
    geoms = [geom for geom in body.geoms if geom.type != mujoco.mjtGeom.mjGEOM_PLANE]
    if not geoms:
        raise ModelError(f"body {body.name!r} is to touch a ball, but has no geom")
    _forbid_what_is_off(spec)
    own = spec.worldbody.add_body(name=BALL, pos=tuple(place))
    own.add_freejoint(name=BALL)
    alone = {"contype": 0, "conaffinity": 0}
    own.add_geom(
        name=BALL, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(ball.radius, 0.0, 0.0), mass=ball.mass,
        rgba=(0.85, 0.35, 0.15, 1.0), **alone,
    )  # fmt: skip
    below = (float(place[0]), float(place[1]), float(place[2]) - ball.radius)
    spec.worldbody.add_geom(
        name=PLATE, type=mujoco.mjtGeom.mjGEOM_PLANE, size=(WIDE, WIDE, THICK), pos=below,
        rgba=(0.8, 0.8, 0.8, 1.0), **alone,
    )  # fmt: skip
    friction = (ball.friction, ball.friction, 0.005, 1e-4, 1e-4)
    condim = 3 if ball.friction > 0 else 1
    spec.add_pair(name=PLATE, geomname1=PLATE, geomname2=BALL, friction=friction, condim=condim)
    for k, geom in enumerate(geoms):
        geom.name = geom.name or f"{BALL} kicker {k}"
        spec.add_pair(
            name=geom.name, geomname1=geom.name, geomname2=BALL, friction=friction, condim=condim,
            solref=ball.solref, solimp=IMPEDANCE,
        )  # fmt: skip
    spec.add_sensor(
        name=TOUCH, type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=mujoco.mjtObj.mjOBJ_GEOM, objname=BALL,
        reftype=mujoco.mjtObj.mjOBJ_BODY, refname=body.name,
        intprm=(1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), NET_FORCE, 1),
    )  # fmt: skip
    return own


NET_FORCE = 3
"""How MuJoCo's contact sensor makes one of several contacts: their sum, in the room's axes."""


def _body_of(spec: Any, kicker: str) -> Any:
    site = spec.site(kicker)
    body = spec.body(kicker) if site is None else site.parent
    if body is None:
        known = [own.name for own in (*spec.sites, *spec.bodies) if own.name]
        raise ModelError(unknown_name("site or body", kicker, known, "ball"))
    if not body.name:
        raise ModelError(f"the body of site {kicker!r} is to touch a ball, but has no name")
    return body


def _forbid_what_is_off(spec: Any) -> None:
    """Where a model has no contacts, let it have those of the ball alone."""
    off = mujoco.mjtDisableBit.mjDSBL_CONTACT.value
    if not spec.option.disableflags & off:
        return
    spec.option.disableflags &= ~off
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    for pair in list(spec.pairs):
        spec.delete(pair)
