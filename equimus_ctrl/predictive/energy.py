"""The mechanical energy of a robot, and the power by which its commands change it.

E is kinetic and potential energy, drives apart. Actuators change it by their power, uᵀ Bᵀ v with B = ∂τ/∂u, whatever
they cannot do otherwise, and no motion comes to rest in a pose but with the energy of that pose (Åström & Furuta,
"Swinging up a pendulum by energy control", Automatica, 2000).
"""

from __future__ import annotations

import itertools

import casadi as ca
import numpy as np

from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.force import laws_of
from equimus_ctrl.engines.native import native
from equimus_ctrl.models.augmented import augmented_model, law_parameters
from equimus_ctrl.models.buffered import Buffered
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.types import Array

MOST_CORNERS = 6
"""Of so many joints all combinations of poses are looked at for how much energy they differ by, else joint by joint."""


class Energy:
    """Of many states at once.

    Args:
        model: whose equations of motion are exact.
        samples: how many states at once at most.
        compiled: whether a C compiler is used where there is one.
    """

    def __init__(self, model: Model, samples: int, compiled: bool = True) -> None:
        robot = changed_bodies(model.effects, model.robot)
        mechanics, laws = robot.mechanics(), laws_of(model.effects)
        form = mechanics.form
        m, base = augmented_model(form, model.phase, laws), build(form, model.phase)
        places = mechanics.law_places
        own = law_parameters(m.slots, model.effects, places["joint"], places["actuator"])
        nj = m.q.numel()
        slope = ca.jacobian(m.drive, m.pressure)
        energy = ca.substitute(base.kinetic + base.potential, ca.vertcat(base.q, base.v, base.p), ca.vertcat(
            m.q, m.v, m.p[: base.p.numel()]
        ))  # fmt: skip
        energy = ca.substitute(energy, base.inside.state, ca.SX.zeros(base.inside.state.shape))
        values = ca.substitute(ca.vertcat(energy, slope.T @ m.v), m.z, m.rest_state)
        values = ca.substitute(values, m.pressure, ca.SX.zeros(m.pressure.shape))
        given = ca.DM([*mechanics.parameters, *own])
        whole = ca.Function("whole", [m.q, m.v], [ca.substitute(values, m.p, given)])
        order = np.argsort(mechanics.joints).tolist()
        x = ca.SX.sym("x", 2 * nj)
        one = ca.Function("energy", [x], [ca.cse(ca.densify(whole(x[:nj][order], x[nj:][order])))])
        one = (native(one, "energy") if compiled else None) or one
        self._call, self._samples, self._nj = Buffered(one.map(samples) if samples > 1 else one), samples, nj

    def __call__(self, states: Array) -> tuple[Array, Array]:
        """(n,) energies [J] and (n, na) power for each unit of command of states (n, 2 nj)."""
        found = []
        for first in range(0, len(states), self._samples):
            own = states[first : first + self._samples]
            given = self._call.arguments[0].reshape(self._samples, -1)
            given[: len(own)], given[len(own) :] = own, 0.0
            self._call()
            found.append(np.array(self._call.results[0].T.reshape(self._samples, -1)[: len(own)]))
        values = np.concatenate(found)
        return values[:, 0], values[:, 1:]

    def span(self, pose: Array, scale: Array, low: Array, high: Array) -> float:
        """By how much poses differ in energy [J].

        Args:
            pose: (nj,) to begin with [rad or m].
            scale: (nj,) how far the others are from it.
            low: (nj,) ends of the joints.
            high: (nj,) the others.
        """
        n = self._nj
        ways = list(itertools.product((0.0, 1.0), repeat=n)) if n <= MOST_CORNERS else [np.zeros(n), *np.eye(n)]
        poses = np.clip(pose + np.array(ways) * scale, low, high)
        values, _ = self(np.hstack([poses, np.zeros_like(poses)]))
        return float(values.max() - values.min())
