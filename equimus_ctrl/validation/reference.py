"""The reference: the symbolic Lagrangian, evaluated by CasADi's own interpreter, integrated by an adaptive method.

Nothing that is generated or compiled for the engines takes part: Dormand and Prince's method of order eight
(scipy's DOP853) on dx/dt = (v, M⁻¹(Jᵀf − h)). Many runs are integrated as one system, restarted where an input jumps.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from equimus_ctrl.computer import Workers
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.models.symbolic_model import SymbolicModel
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, pack, structure
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.types import Array
from equimus_ctrl.validation.experiment import Experiment

RTOL, ATOL = 1e-10, 1e-12
TIGHT = 1e-2
"""Factor on both tolerances in the run that shows the reference's own error."""

BLOCK = 250
STOP_BLOCK = 25
STOP_TOLERANCE = 100.0
"""Factor on both tolerances of runs that touch a stop: at a kink of the right-hand side, steps shrink to nothing."""

SHORTEST = 0.03
"""An actuator shorter than this is beyond any robot's, and its direction soon undefined [m]."""


@lru_cache(maxsize=64)
def _functions(form: Structure, phase: Phase) -> dict[str, ca.Function]:
    m = build(form, phase)
    free = ca.SX.zeros(m.tau.shape)
    a = ca.substitute(m.acceleration, m.tau, free)
    at_rest = [ca.substitute(ca.jacobian(a, x), m.v, ca.SX.zeros(m.v.shape)) for x in (m.q, m.v)]
    pressure = m.static_pressure
    left = m.jacobian.T @ (m.area * pressure) - m.static_bias
    loss = ca.dot(m.v, m.bias + m.stop_torque - _conservative(m))
    loss_rate = ca.substitute(ca.jtimes(loss, m.q, m.v) + ca.jtimes(loss, m.v, a), m.tau, free)
    return {
        "acceleration": ca.Function("acceleration", [m.q, m.v, m.f, m.p], [a]),
        "linear": ca.Function("linear", [m.q, m.f, m.p], at_rest),
        "holding": ca.Function("holding", [m.q, m.p], [pressure, left]),
        "lengths": ca.Function("lengths", [m.q, m.p], [m.lengths]),
        "energy": ca.Function("energy", [m.q, m.v, m.p], [m.kinetic, m.potential]),
        "momentum": ca.Function("momentum", [m.q, m.v, m.p], [m.mass @ m.v]),
        "loss": ca.Function("loss", [m.q, m.v, m.f, m.p], [loss, loss_rate]),
    }


def _conservative(m: SymbolicModel) -> ca.SX:
    """(nj,) what the bias is without damping: the inertial terms and ∂V/∂q."""
    undone = ca.jtimes(m.mass @ m.v, m.q, m.v) - ca.gradient(m.kinetic, m.q)
    return undone + m.static_bias


@lru_cache(maxsize=64)
def _numeric(form: Structure, phase: Phase, parameters: tuple[float, ...]) -> ca.Function:
    """The acceleration with its parameters put in: a third of the operations."""
    m = build(form, phase)
    values = ca.vertcat(ca.SX.zeros(m.tau.shape), ca.DM(list(parameters)))
    return ca.Function("acceleration", [m.q, m.v, m.f], [ca.substitute(m.acceleration, ca.vertcat(m.tau, m.p), values)])


def evaluate(name: str, morphology: Morphology, *columns: Array, phase: Phase = "swing") -> list[Array]:
    """A function of the symbolic model at many points.

    Args:
        name: ``"acceleration"``, ``"linear"``, ``"holding"``, ``"lengths"``, ``"energy"``, ``"momentum"`` or
            ``"loss"``.
        morphology: whose.
        columns: the function's arguments but the last, each (n, …).
        phase: base fixed or foot pinned.

    Returns:
        Each result as (n, rows·columns), a matrix column by column.
    """
    n = len(columns[0])
    function = _functions(structure(morphology), phase)[name].map(n)
    parameters = np.repeat(pack(morphology)[:, None], n, axis=1)
    results = function.call([*(ca.DM(np.ascontiguousarray(c.T)) for c in columns), ca.DM(parameters)])
    return [np.array(r).reshape(r.shape[0], n, -1).transpose(1, 2, 0).reshape(n, -1) for r in results]


def integrate(experiment: Experiment, *, rtol: float = RTOL, atol: float = ATOL) -> tuple[Array, Array]:
    """Angles and velocities of all runs as one system.

    scipy's error norm is a root mean square over all components, so one run of n may err √n times more than the
    tolerances say; what the error really is, a tighter run shows.

    Args:
        experiment: its runs.
        rtol: relative tolerance of every step.
        atol: absolute tolerance of every step [rad and rad/s].

    Returns:
        q (n, m, nj) [rad] and v (n, m, nj) [rad/s] at the experiment's times; NaN for a run that cannot be
        integrated.
    """
    n, nj = experiment.start.shape
    function = _right_side(experiment)
    times = experiment.times
    out = np.full((2, nj, n, len(times)), np.nan)
    x = np.concatenate([experiment.start.T, np.zeros((nj, n))])
    force = experiment.force
    edges = [*experiment.switch.tolist(), experiment.duration]
    out[:, :, :, 0] = x.reshape(2, nj, n)
    for k, (begin, end) in enumerate(itertools.pairwise(edges)):
        held = np.ascontiguousarray(force[:, k].T)

        def rate(t: float, flat: Array, held: Array = held) -> Array:
            state = flat.reshape(2 * nj, n)
            return np.concatenate([state[nj:], function(state[:nj], state[nj:], held)]).ravel()

        inside = np.flatnonzero((times > begin + 1e-9) & (times <= end + 1e-9))
        with np.errstate(all="ignore"):
            found = solve_ivp(
                rate, (begin, end), x.ravel(), method="DOP853", t_eval=np.append(times[inside][:-1], end),
                rtol=rtol, atol=atol,
            )  # fmt: skip
        if not found.success:
            if n == 1:
                return _rows(out)
            # One run that leaves every bound stops them all; alone, the others go through.
            alone = [integrate(experiment.part(slice(i, i + 1)), rtol=rtol, atol=atol) for i in range(n)]
            return np.concatenate([a[0] for a in alone]), np.concatenate([a[1] for a in alone])
        states = found.y.reshape(2, nj, n, -1)
        out[..., inside] = states
        x = states[..., -1].reshape(2 * nj, n)
    return _rows(out)


def _rows(out: Array) -> tuple[Array, Array]:
    q, v = np.ascontiguousarray(out.transpose(0, 2, 3, 1))
    return q, v


def _right_side(experiment: Experiment) -> Callable[[Array, Array, Array], Array]:
    first, n = experiment.morphologies[0], experiment.size
    form = structure(first)
    if len(experiment.morphologies) == 1:
        numeric = _numeric(form, experiment.phase, tuple(pack(first).tolist())).map(n)
        return lambda q, v, f: np.asarray(numeric(q, v, f).full())
    mapped = _functions(form, experiment.phase)["acceleration"].map(n)
    parameters = ca.DM(np.ascontiguousarray(experiment.parameters.T))
    return lambda q, v, f: np.asarray(mapped(q, v, f, parameters).full())


def reference_runs(
    experiment: Experiment,
    near_stop: NDArray[np.bool_] | None = None,
    progress: Callable[[float], None] = lambda share: None,
    factor: float = 1.0,
    pool: Workers | None = None,
) -> Array:
    """(n, m, nj) angles of all runs [rad], integrated in blocks; where they are integrated makes no difference.

    Args:
        experiment: its runs.
        near_stop: (n,) runs that may touch a stop, by any guess: they are integrated separately from the others,
            because their kinks would cost all of a block their steps.
        progress: called with the share done.
        factor: on all tolerances.
        pool: processes for the blocks; this one by default.
    """
    near = np.zeros(experiment.size, dtype=bool) if near_stop is None else near_stop
    out = np.full((experiment.size, len(experiment.times), experiment.start.shape[1]), np.nan)
    blocks = []
    for rows, size, slack in (
        (np.flatnonzero(near), STOP_BLOCK, factor * STOP_TOLERANCE),
        (np.flatnonzero(~near), BLOCK, factor),
    ):
        blocks += [(part, slack) for part in _evenly(rows, size)]
    for i, (rows, q) in enumerate(_integrated(experiment, blocks, pool)):
        out[rows] = q
        progress((i + 1) / len(blocks))
    return out


_Rows = NDArray[np.int64]


def _integrated(
    experiment: Experiment, blocks: list[tuple[_Rows, float]], pool: Workers | None
) -> Iterator[tuple[_Rows, Array]]:
    """Each block's rows and their angles, as they are ready."""
    tasks = [(experiment.part(rows), slack) for rows, slack in blocks]
    for index, q in (pool or Workers()).each(_angles, tasks):
        yield blocks[index][0], q


def _angles(runs: Experiment, slack: float) -> Array:
    return integrate(runs, rtol=RTOL * slack, atol=ATOL * slack)[0]


def _evenly(rows: _Rows, size: int) -> list[_Rows]:
    """Rows in parts of at most ``size``, an even number of them where there are enough rows for two."""
    if len(rows) == 0:
        return []
    parts = min(2 * math.ceil(len(rows) / (2 * size)), len(rows))
    return np.array_split(rows, parts)


def own_error(
    experiment: Experiment,
    q: Array,
    rows: NDArray[np.int64],
    near_stop: NDArray[np.bool_] | None = None,
    pool: Workers | None = None,
) -> float:
    """The largest difference [rad] between some of ``reference_runs`` q and the same at a hundredth of the tolerances.

    Args: as of ``reference_runs``, and ``rows`` of the runs that are repeated.
    """
    if len(rows) == 0:
        return float("nan")
    near = None if near_stop is None else near_stop[rows]
    tight = reference_runs(experiment.part(rows), near, factor=TIGHT, pool=pool)
    return float(np.abs(tight - q[rows]).max())


def shortest(experiment: Experiment, q: Array) -> Array:
    """(n,) the least length that any actuator has in each run [m]; 0 for a run with NaN."""
    out = np.zeros(experiment.size)
    sound = np.isfinite(q).all(axis=(1, 2))
    own = experiment.morphologies
    for i in np.flatnonzero(sound):
        out[i] = evaluate("lengths", own[i if len(own) > 1 else 0], q[i])[0].min()
    return out
