"""An MJCF robot as compiled equations take it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from equimus_ctrl.effects.following import DIRECT, FILTERED, INTEGRATED, SLEWED
from equimus_ctrl.robots.mechanics import Channel, Mechanics
from equimus_ctrl.robots.mjcf.form import FAR, TreeForm
from equimus_ctrl.robots.mjcf.packing import Drive, commands_between, pack
from equimus_ctrl.robots.mjcf.parts import Coupling, Surface, Tether, hook_of
from equimus_ctrl.robots.mjcf.plan import Assets
from equimus_ctrl.robots.mjcf.reading import form_of

_forms: dict[Any, TreeForm] = {}


def mechanics_of(
    model: Any,
    xml: str,
    assets: Assets,
    joint_names: Sequence[str],
    other_names: Sequence[str],
    drives: Mapping[str, Drive],
    tethers: Sequence[Tether],
    surfaces: Sequence[Surface],
    couplings: Sequence[Coupling],
) -> Mechanics:
    """The equations' form and parameters of a robot.

    Args:
        model: its ``mujoco.MjModel``, effects on its bodies and drives included.
        xml: from which it was made.
        assets: files that the XML names.
        joint_names: of the joints that are measured.
        other_names: of those whose motion is an input, or not measured.
        drives: joint whose drive turns by itself → see ``packing.pack``.
        tethers: springs to points of the room.
        surfaces: level planes in it that points touch.
        couplings: friction over two joints.

    Raises:
        ModelError: where the equations cannot hold it.
    """
    form = _form((xml, assets, bool(drives), bool(tethers), bool(surfaces), bool(couplings)), model)
    names = [link.name for link in form.links]
    joints = np.array([names.index(name) for name in joint_names], dtype=np.int64)
    order = [*joint_names, *other_names]
    starts = np.array([order.index(name) for name in names], dtype=np.int64)
    loose = {names.index(name): drive for name, drive in drives.items()}
    springs, touches = {}, {}
    for tether in tethers:
        body, point = hook_of(model, tether.place)
        springs[body] = tether.stiffness, tether.length, point, np.array(tether.anchor)
    for surface in surfaces:
        body, point = hook_of(model, surface.place)
        touches[body] = point, np.array(surface.up), surface.height, surface.time_constant
    numbers = pack(form, model, loose, springs, touches, couplings)
    places = {"joint": names, "actuator": ()}
    return Mechanics(form, numbers, joints, starts, places, tuple(_channels(form, model)))


def _form(key: Any, model: Any) -> TreeForm:
    if key not in _forms:
        if len(_forms) > 256:
            _forms.clear()
        _forms[key] = form_of(model, flexible=key[2], tethered=key[3], surfaced=key[4], coupled=key[5])
    return _forms[key]


def _channels(form: TreeForm, model: Any) -> list[Channel]:
    """Of each command of each actuator."""
    kinds = {"none": DIRECT, "filter": FILTERED, "integrator": INTEGRATED, "slew": SLEWED}
    found = []
    for i, own in enumerate(form.actuators):
        k = own.index
        for n in range(len(own.inputs)):
            low, high = commands_between(form, model, i, n)
            kind = kinds[own.dynamics] if n == 0 else DIRECT
            bounded = own.limited_act and kind in (FILTERED, INTEGRATED)
            least, most = model.actuator_actrange[k] if bounded else (-FAR, FAR)
            number = float(model.actuator_dynprm[k, {"pid": 1, "dcmotor": 7}.get(own.law, 0)])
            number = 0.0 if kind == DIRECT else number
            delay = float(model.actuator_delay[k])
            found.append(Channel(low, high, delay, kind, number, float(least), float(most), i))
    return found
