"""What forces of any shape have in common that are simulated beside the laws of a hypothesis (``effects.smooth``)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np
from scipy.special import chdtri

from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part
from equimus_ctrl.diagnosis.localization import speeds
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.diagnosis.torque_screening import CORRELATED, torque_screen
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.engines.mjcf_inverse import law_force
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.types import Array

WIDER = (1, 2)
"""Widths of the test functions at which the torque domain is asked, over that of the search: wide ones see slow forces
better."""
CONFIDENT = 1.96
"""Standard errors of a force's 95 % interval, by the normal distribution."""


def asked_in_torques(search: Search, best: Fitted, candidates: Sequence[Candidate]) -> list[Candidate]:
    """Of forces beside a hypothesis those that the torque domain asks for; all where there is none.

    Args:
        search: that ended.
        best: the hypothesis.
        candidates: the forces, linear in their parameters.

    Raises:
        BudgetSpent: where the budget ends.
    """
    data, domain = search.data, search.torque_domain
    gains: dict[Candidate, float] = {}
    if domain is not None and candidates:
        for times in WIDER:
            wider = replace(domain, width=times * domain.width)
            for own, fit in torque_screen(data, wider, best, candidates).alone().items():
                gains[own] = max(gains.get(own, 0.0), fit.gain / CORRELATED)

    def worth_asking(one: Candidate, t: Thresholds) -> bool:
        return gains.get(one, math.inf) > float(chdtri(one.n_parameters, t.smooth_asked / len(candidates)))

    return [one for one in candidates if data.thresholds.decides(partial(worth_asking, one))]


def fitted_without(search: Search, rich: Fitted, hypothesis: Hypothesis) -> Fitted | None:
    """What is left of a hypothesis without some of its parts, fitted to the end; None where it diverges.

    Args:
        search: that ended.
        rich: the hypothesis with them.
        hypothesis: without.

    Raises:
        BudgetSpent: where the budget ends.
    """
    data = search.data
    begin = (data.theta_of(rich.fit.theta, hypothesis), rich.fit.starts)
    try:
        simpler = data.coarse_fit(hypothesis, [begin], rich.noise, search.settings.long_steps)
        return data.converge(simpler) if search.accepts(simpler, rich) else simpler
    except SimulationDiverged:
        return None


def joints_of(search: Search, part: Part) -> set[str]:
    """The joints at which a part acts: its places, or those that its actuators drive."""
    robot, places = search.data.free.model.robot, set(part.candidate.locations)
    driven = [robot.driven_joints(name) for name in robot.actuator_names if name in places]
    return places.intersection(robot.joint_names).union(*driven)


def alone_at(search: Search, fitted: Fitted) -> dict[str, list[int]]:
    """Joints at which parts of a hypothesis act, and nowhere else, with the places of these."""
    found: dict[str, list[int]] = {}
    for k, part in enumerate(fitted.hypothesis):
        joints = joints_of(search, part)
        if len(joints) == 1:
            found.setdefault(joints.pop(), []).append(k)
    return found


def along(search: Search, joint: str) -> tuple[Array, Array]:
    """(n,) positions and rates of a joint at the instants that were measured."""
    data = search.data
    j = data.free.model.robot.joint_names.index(joint)
    return (
        np.concatenate([segment.measured[:, j] for segment in data.segments]),
        np.concatenate([speeds(segment)[:, j] for segment in data.segments]),
    )


def force_of(part: Part, joint: str, x: Array, rate: Array) -> Array:
    """(n,) what a force law exerts at a joint, at positions and rates (n,) of it."""
    values = part.candidate.at(part.values, joint)
    return law_force(cast("type[ForceEffect]", part.candidate.effect), values, x, rate, np.zeros_like(x))


def share_beyond(force: Array, columns: Array) -> float:
    """The share of a force's square that no sum of columns (n, k) is."""
    left = force - columns @ np.linalg.lstsq(columns, force, rcond=None)[0]
    return float(left @ left) / max(float(force @ force), 1e-300)


def another_law(share: float, t: Thresholds) -> bool:
    """Whether a force of which that share is not a law, whatever the law's size, is another one."""
    return share > t.no_constant
