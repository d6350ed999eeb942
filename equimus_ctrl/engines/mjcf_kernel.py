"""Physics steps of MJCF robots: MuJoCo's own, and what it has no field for before each of them, in machine code.

A step of a small robot takes MuJoCo one or two microseconds; Python between two of them would take ten times that.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped, unused-ignore]
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from equimus_ctrl.engines.mjcf_functions import N_STATES, joint_force, state_tuple
from equimus_ctrl.types import Array


@intrinsic  # type: ignore[untyped-decorator, unused-ignore]
def call(context: Any, address: Any, model: Any, data: Any) -> Any:
    """Call a C function void(const mjModel*, mjData*) at an address; numba keeps no function pointers in its cache."""

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        pointer = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer, pointer])
        function = builder.inttoptr(given[0], kind.as_pointer())
        builder.call(function, [builder.inttoptr(given[1], pointer), builder.inttoptr(given[2], pointer)])
        return target.get_dummy_value()

    return types.void(types.intp, types.intp, types.intp), generate


@njit(cache=True, nogil=True, error_model="numpy")
def called(address: int, model: int, data: int) -> None:
    """Call one of MuJoCo's functions void(const mjModel*, mjData*)."""
    call(address, model, data)  # type: ignore[call-arg]


@njit(cache=True, nogil=True, error_model="numpy")
def run_mjcf(
    step: int,
    model: int,
    data: int,
    places: NDArray[np.int64],
    laws: Array,
    loss: Array,
    fastest: Array,
    ctrl: Array,
    force: Array,
    states: Array,
    qpos: Array,
    qvel: Array,
    control: Array,
    applied: Array,
    frictionloss: Array,
    driven: Array,
    dt: float,
    moved: NDArray[np.int64],
    given_q: Array,
    given_v: Array,
    out_q: Array,
    out_v: Array,
    act: Array,
    whole: Array,
) -> int:
    """Step a robot; the number of steps after which all was still sound.

    Args:
        step: address of MuJoCo's ``mj_step``.
        model: address of its ``mjModel``.
        data: address of its ``mjData``, at the start.
        places: (nj, 3) places of the joints in qpos and in qvel, and in qvel of what drives them.
        laws: (nj, nc) prepared constants of each joint's laws.
        loss: (nj,) dry friction that the model itself has [N·m or N].
        fastest: (nj,) rates beyond which it has diverged [rad/s or m/s].
        ctrl: (steps, na) commands that act over each step.
        force: (steps, nj) further generalised forces on the joints [N·m or N]; (0, nj) for none.
        states: (nj, nz) the laws' states, kept.
        qpos: view of the data's.
        qvel: view of the data's.
        control: view of the data's ctrl.
        applied: view of the data's qfrc_applied.
        frictionloss: view of the model's dof_frictionloss.
        driven: view of the data's qfrc_actuator.
        dt: physics step [s].
        moved: (np, 2) places in qpos and in qvel of joints whose motion is prescribed.
        given_q: (steps + 1, np) where these are [rad or m].
        given_v: (steps + 1, np) their rates.
        out_q: (steps + 1, nj) written: where the joints are.
        out_v: (steps + 1, nj) written: their rates.
        act: view of the data's.
        whole: (steps + 1, nq + nv + na) written: all of qpos, qvel and act; (0, …) where it is not wanted.
    """
    nj, nq, nv = len(places), len(qpos), len(qvel)
    for k in range(len(ctrl) + 1):
        for m in range(len(moved)):
            qpos[moved[m, 0]], qvel[moved[m, 1]] = given_q[k, m], given_v[k, m]
        for j in range(nj):
            out_q[k, j], out_v[k, j] = qpos[places[j, 0]], qvel[places[j, 1]]
            if not abs(out_v[k, j]) < fastest[j]:
                return k
        if len(whole) > 0:
            whole[k, :nq], whole[k, nq : nq + nv], whole[k, nq + nv :] = qpos, qvel, act
        if k == len(ctrl):
            break
        for i in range(ctrl.shape[1]):
            control[i] = ctrl[k, i]
        for j in range(nj):
            dof = places[j, 1]
            found = joint_force((out_q[k, j], out_v[k, j], driven[places[j, 2]], dt), state_tuple(states[j]), laws[j])
            applied[dof] = found[0] + (force[k, j] if len(force) > 0 else 0.0)
            frictionloss[dof] = loss[j] + found[1]
        called(step, model, data)
        # The laws' states go on with the rate after the step: a stiff law that went on with that before it would gain
        # energy from step to step.
        for j in range(nj):
            at = (qpos[places[j, 0]], qvel[places[j, 1]], driven[places[j, 2]], dt)
            found = joint_force(at, state_tuple(states[j]), laws[j])
            for s in range(N_STATES):
                states[j, s] += found[2 + s]
    return len(ctrl) + 1


@njit(cache=True, nogil=True, error_model="numpy")
def exert_laws(
    rows: NDArray[np.int64],
    places: NDArray[np.int64],
    laws: Array,
    loss: Array,
    states: Array,
    qpos: Array,
    qvel: Array,
    driven: Array,
    dt: float,
    applied: Array,
    frictionloss: Array,
) -> None:
    """What ``run_mjcf`` does before a step, of many robots.

    Args:
        rows: of which.
        places: (nj, 3) as there.
        laws: (n, nj, nc) of each.
        loss: (n, nj) of each.
        states: (n, nj, nz) of each.
        qpos: (n, nq).
        qvel: (n, nv).
        driven: (n, nv) generalised forces of actuators over the last step.
        dt: physics step [s].
        applied: (n, nv) written.
        frictionloss: (n, nv) written.
    """
    for e in rows:
        for j in range(len(places)):
            dof = places[j, 1]
            at = (qpos[e, places[j, 0]], qvel[e, dof], driven[e, places[j, 2]], dt)
            found = joint_force(at, state_tuple(states[e, j]), laws[e, j])
            applied[e, dof], frictionloss[e, dof] = found[0], loss[e, j] + found[1]


@njit(cache=True, nogil=True, error_model="numpy")
def move_laws(
    rows: NDArray[np.int64],
    places: NDArray[np.int64],
    laws: Array,
    states: Array,
    qpos: Array,
    qvel: Array,
    driven: Array,
    dt: float,
) -> None:
    """What ``run_mjcf`` does after a step, of many robots; see ``exert_laws``."""
    for e in rows:
        for j in range(len(places)):
            at = (qpos[e, places[j, 0]], qvel[e, places[j, 1]], driven[e, places[j, 2]], dt)
            found = joint_force(at, state_tuple(states[e, j]), laws[e, j])
            for s in range(N_STATES):
                states[e, j, s] += found[2 + s]


@njit(cache=True, nogil=True, error_model="numpy")
def drive_forces(
    functions: NDArray[np.int64],
    model: int,
    data: int,
    states: Array,
    ctrl: Array,
    qpos: Array,
    qvel: Array,
    act: Array,
    control: Array,
    force: Array,
    which: NDArray[np.int64],
    out: Array,
) -> None:
    """Forces of actuators in some states, before the gear.

    Args:
        functions: addresses of MuJoCo's functions that lead from a state to ``actuator_force``, in their order.
        model: address of its ``mjModel``.
        data: address of its ``mjData``.
        states: (m, nq + nv + na) qpos, qvel and act.
        ctrl: (m, nu) what has arrived of the commands.
        qpos: view of the data's.
        qvel: view of the data's.
        act: view of the data's.
        control: view of the data's ctrl.
        force: view of the data's actuator_force.
        which: (nc,) actuators.
        out: (m, nc) written [N·m or N]; nan where a state is not finite.
    """
    nq, nv = len(qpos), len(qvel)
    for k in range(len(states)):
        out[k] = np.nan
        if not np.all(np.isfinite(states[k])):
            continue
        qpos[:], qvel[:], act[:] = states[k, :nq], states[k, nq : nq + nv], states[k, nq + nv :]
        control[:] = ctrl[k]
        for function in functions:
            call(function, model, data)  # type: ignore[call-arg]
        for i in range(len(which)):
            out[k, i] = force[which[i]]
