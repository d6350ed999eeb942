"""Trajectories of MuJoCo: RK4 at one step, and what that tends to as the step tends to zero.

``reference``
is MuJoCo's RK4 at one step, ``converged`` what that tends to as the step tends to zero. Halving alone does not get
there, for RK4 in MuJoCo is of first order wherever a limit switches on, for dry friction, and for ``filterexact``,
``actearly``, a held ``actrange``, slew limits, delays, and the current and the bristle of a DC motor, whose updates
contain the step. ``converged`` therefore integrates q̈ and ȧ of ``mj_forward`` with an error-controlled method of eighth
order (DOP853 of Hairer, Nørsett & Wanner, *Solving Ordinary Differential Equations I*), the step within MuJoCo's laws
set to nothing.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
from mujoco.rollout import rollout
from scipy.integrate import DOP853

from equimus_ctrl.errors import ConfigError, ModelError, SimulationDiverged
from equimus_ctrl.quiet import quietly
from equimus_ctrl.types import Array

LONGEST = 0.01
"""Step of ``converged``, that no limit is stepped over [s]."""
HARD = 0.9999
"""Impedance of hardened dry friction, the largest there is."""


def rolled(model: Any, data: Any, start: Array, ctrl: Array) -> Array:
    """(k, n, size of the state) after each step of commands (n, nu), from each start (k, size)."""
    given = ctrl[None].repeat(len(start), 0) if model.nu else None
    return np.array(rollout(model, data, start, given, nstep=len(ctrl))[0])


def tightened(xml: str) -> tuple[Any, Array]:
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


@quietly()
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
    model, delays = tightened(xml)
    at = np.append(times[times < duration - 1e-9], duration)
    if (wrong := np.abs(np.remainder(np.append(at, delays) / step + 0.5, 1) - 0.5) > 1e-6).any():
        raise ConfigError(f"the step {step} s does not divide {np.append(at, delays)[wrong][0]} s")
    model = hardened(model, 1 / step) if _rubs(model) else model
    model.opt.timestep = step
    data, rows = mujoco.MjData(model), np.round(at / step).astype(int)
    start = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    given = _given(times, ctrl, delays, np.arange(rows[-1]) * step)
    states = rolled(model, data, start[None], given)[0]
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


@quietly()
def converged(xml: str, times: Array, ctrl: Array, duration: float, target: float | None = None) -> Converged:
    """Refine the motion until that changes it by less than the target: 1e-8, with dry friction 1e-6 [rad, m].

    The error of hardened friction goes with 1/rate, and positions are extrapolated to 1/rate = 0. After six refinements
    the result is what it is, see its ``change``.

    Args: as of ``reference``.

    Raises:
        SimulationDiverged: where the motion cannot be followed.
    """
    model, delays = tightened(xml)
    at = np.append(times[times < duration - 1e-9], duration)
    rubs, last, before = _rubs(model), None, None
    for k in range(6):
        tolerance, rate = (1e-10, 2e3 * 2**k) if rubs else (10.0 ** -(7 + k), np.inf)
        found = limit_of(hardened(model, rate) if rubs else copy(model), times, ctrl, delays, at, tolerance)
        q = found if last is None or not rubs else 2 * found - last
        change = np.inf if before is None else float(np.abs(q - before).max())
        if change < (target or (1e-6 if rubs else 1e-8)):
            break
        before, last = q, found
    return Converged(at, q, tolerance, rate, change)


def limit_of(
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
