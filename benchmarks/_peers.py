"""Other packages' controllers, wrapped as a user would: classes with ``init`` and ``step`` on what ``eq`` offers.

Each wrapper is all that its user writes, ``lines_of`` counts it. Weights are Bryson's: an error, a rate or a command as
large as its allowance costs as much as one another.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import tokenize
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

import equimus_ctrl as eq

PACKAGES = {"python-control": "control", "do-mpc": "do-mpc", "judo": "judo-rai"}
"""Peer → the package that it comes with."""


class FilteredDifference:
    """Velocities from positions alone: differences behind a low-pass."""

    def __init__(self, dt: float, time: float) -> None:
        self.dt, self.share, self.before, self.rate = dt, dt / (time + dt), None, 0.0

    def __call__(self, position: np.ndarray) -> np.ndarray:
        if self.before is not None:
            self.rate = self.rate + self.share * ((position - self.before) / self.dt - self.rate)
        self.before = position
        return self.rate + np.zeros_like(position)


class ControlLqr:
    """MuJoCo's finite differences along the path, python-control's gain, the error's integral, inverse dynamics."""

    name = "python-control"

    def __init__(self, position: float, rate: float, effort: Any, integral: float = 0.0, time: float = 0.016) -> None:
        self.position, self.rate, self.effort, self.integral, self.time = position, rate, effort, integral, time

    def init(self, spec: eq.PlantSpec, observation: eq.Observation) -> SimpleNamespace:
        model = spec.model.mujoco_model()
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        velocity = FilteredDifference(spec.control_dt, self.time)
        return SimpleNamespace(
            model=model, data=mujoco.MjData(model), dt=spec.control_dt, velocity=velocity, pose=None, gain=None,
            total=np.zeros(model.nv), low=spec.command_low, high=spec.command_high,
        )  # fmt: skip

    def step(self, observation: eq.Observation, reference: eq.Reference, s: SimpleNamespace) -> tuple[np.ndarray, Any]:
        h = 0.03  # the reference is joined by straight lines
        before, now, after = (reference.position(observation.time + k * h) for k in (-1, 0, 1))
        rate, acceleration = (after - before) / (2 * h), (after - 2 * now + before) / h**2
        s.data.qpos[:], s.data.qvel[:], s.data.qacc[:] = now, rate, acceleration
        mujoco.mj_inverse(s.model, s.data)
        joints = s.model.actuator_trnid[:, 0]
        fed = s.data.qfrc_inverse[joints] / s.model.actuator_gear[:, 0]
        if s.pose is None or np.abs(now - s.pose).max() > 0.05:
            s.pose, s.gain = now, self.gain(s, now, fed)
        error = np.asarray(observation.position) - now
        state = np.concatenate([error, s.velocity(np.asarray(observation.position)) - rate, s.total])
        asked = fed - s.gain @ state[: s.gain.shape[1]]
        command = np.clip(asked, s.low, s.high)
        if np.array_equal(command, asked):
            s.total = s.total + s.dt * error
        return command, s

    def gain(self, s: SimpleNamespace, pose: np.ndarray, command: np.ndarray) -> np.ndarray:
        import control

        n, na = s.model.nv, s.model.nu
        data = mujoco.MjData(s.model)
        data.qpos[:], data.ctrl[:] = pose, command
        once, drive = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, na))
        mujoco.mjd_transitionFD(s.model, data, 1e-6, True, once, drive, None, None)
        a, b = np.eye(2 * n), np.zeros((2 * n, na))
        for _ in range(round(s.dt / s.model.opt.timestep)):
            a, b = once @ a, once @ b + drive
        weights = [1 / self.position**2] * n + [1 / self.rate**2] * n
        if self.integral:
            a = np.block([[a, np.zeros((2 * n, n))], [s.dt * np.eye(n), np.zeros((n, n)), np.eye(n)]])
            b, weights = np.vstack([b, np.zeros((n, na))]), [*weights, *[1 / self.integral**2] * n]
        return control.dlqr(a, b, np.diag(weights), np.eye(na) / np.square(self.effort))[0]


class DoMpc:
    """do-mpc's NMPC (collocation, IPOPT) on the package's equations; what is not explained is an acceleration."""

    name = "do-mpc"

    def __init__(
        self, position: float, rate: float, change: Any, nodes: int, stride: int = 2, every: int = 1,
        wraps: Sequence[int] = (), settle: float = 0.1, time: float = 0.016,
    ) -> None:  # fmt: skip
        self.position, self.rate, self.change, self.nodes, self.stride = position, rate, change, nodes, stride
        self.every, self.wraps, self.settle, self.time = every, wraps, settle, time

    def init(self, spec: eq.PlantSpec, observation: eq.Observation) -> SimpleNamespace:
        import casadi as ca
        import do_mpc

        a = eq.accelerations(eq.Model(spec.model, spec.effects, spec.phase))
        n, na, step = len(spec.joints), len(spec.actuators), self.stride * spec.control_dt
        model = do_mpc.model.Model("continuous", "SX")
        q, v = model.set_variable("_x", "q", (n, 1)), model.set_variable("_x", "v", (n, 1))
        u = model.set_variable("_u", "u", (na, 1))
        wanted, moving, off = (model.set_variable("_tvp", name, (n, 1)) for name in ("wanted", "moving", "off"))
        model.set_rhs("q", v)
        model.set_rhs("v", a(q, v, u) + off)
        model.setup()
        error = [2 * ca.sin((q[i] - wanted[i]) / 2) if i in self.wraps else q[i] - wanted[i] for i in range(n)]
        cost = ca.sumsqr(ca.vertcat(*error)) / self.position**2 + ca.sumsqr(v - moving) / self.rate**2
        mpc = do_mpc.controller.MPC(model)
        mpc.settings.n_horizon, mpc.settings.t_step, mpc.settings.store_full_solution = self.nodes, step, False
        mpc.settings.supress_ipopt_output()
        mpc.settings.nlpsol_opts["ipopt.max_iter"] = 200  # of 3,000 by default, which take seconds
        mpc.set_objective(mterm=10 * cost, lterm=cost)
        mpc.set_rterm(u=np.broadcast_to(1 / np.square(self.change), na))
        mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = spec.command_low, spec.command_high
        s = SimpleNamespace(
            mpc=mpc, a=a, dt=spec.control_dt, velocity=FilteredDifference(spec.control_dt, self.time), count=0,
            before=None, off=np.zeros(n), status="", command=np.array(observation.command), now=0.0, reference=None,
        )  # fmt: skip
        template = mpc.get_tvp_template()

        def ahead(_: float) -> Any:
            for k in range(self.nodes + 1):
                at = s.now + k * step
                here, later = (s.reference.position(at + d) for d in (0.0, 0.01)) if s.reference else (np.zeros(n),) * 2
                template["_tvp", k, "wanted"], template["_tvp", k, "moving"] = here, (later - here) / 0.01
                template["_tvp", k, "off"] = s.off
            return template

        mpc.set_tvp_fun(ahead)
        mpc.setup()
        mpc.x0, mpc.u0 = np.concatenate([observation.position, np.zeros(n)]), s.command
        mpc.set_initial_guess()
        return s

    def step(self, observation: eq.Observation, reference: eq.Reference, s: SimpleNamespace) -> tuple[np.ndarray, Any]:
        q = np.asarray(observation.position)
        v = s.velocity(q)
        if s.before is not None:  # what the equations do not explain of the motion
            v_then, a_then = s.before
            s.off = s.off + s.dt / self.settle * ((v - v_then) / s.dt - a_then - s.off)
        s.count += 1
        s.status = "held"
        if (s.count - 1) % self.every == 0:
            s.now, s.reference = observation.time, reference
            with contextlib.redirect_stdout(io.StringIO()):
                found = np.array(s.mpc.make_step(np.concatenate([q, v]).reshape(-1, 1))).ravel()
            s.status = "solved" if s.mpc.solver_stats["success"] else "failed"
            s.command = found if s.status == "solved" else s.command
        s.before = v, np.array(s.a(q, v, s.command)).ravel()
        return s.command, s


class Judo:
    """judo's sampling planner: splines of commands, rolled out in MuJoCo, every ``every``-th control period."""

    name = "judo"

    def __init__(
        self, file: Path, position: float, rate: float, effort: Any, sigma: Any, horizon: float, seed: int,
        optimizer: str = "ps", nodes: int = 4, rollouts: int = 32, every: int = 5, wraps: Sequence[int] = (),
        first: Callable[[], np.ndarray] | None = None, time: float = 0.016,
    ) -> None:  # fmt: skip
        self.file, self.position, self.rate, self.effort, self.sigma = file, position, rate, effort, sigma
        self.horizon, self.seed, self.optimizer, self.nodes, self.rollouts = horizon, seed, optimizer, nodes, rollouts
        self.every, self.wraps, self.first, self.time = every, list(wraps), first, time

    def init(self, spec: eq.PlantSpec, observation: eq.Observation) -> SimpleNamespace:
        from judo.controller import Controller, ControllerConfig
        from judo.optimizers import get_registered_optimizers
        from judo.tasks import Task, TaskConfig

        own, start = self, np.array(observation.command)

        class Following(Task):
            def reward(self, states: Any, sensors: Any, controls: Any, config: Any, system_metadata: Any = None) -> Any:
                n = self.model.nq
                error = states[..., :n] - system_metadata["wanted"]
                error[..., own.wraps] = 2 * np.sin(error[..., own.wraps] / 2)
                cost = (error**2).sum(-1) / own.position**2
                cost += ((states[..., n:] - system_metadata["moving"]) ** 2).sum(-1) / own.rate**2
                return -(cost + ((controls / own.effort) ** 2).sum(-1)).sum(-1)

            def optimizer_warm_start(self) -> np.ndarray:
                return start

        np.random.seed(self.seed)  # judo draws from the global generator
        kind, config = get_registered_optimizers()[self.optimizer]
        spread = {"sigma_min": np.divide(self.sigma, 4), "sigma_max": self.sigma} if self.optimizer == "cem" else {
            "sigma": self.sigma
        }  # fmt: skip
        settings = config(num_rollouts=self.rollouts, num_nodes=self.nodes, **spread)
        task = Following(str(self.file))
        planner = Controller(
            ControllerConfig(horizon=self.horizon), task, TaskConfig(), kind(settings, task.nu), settings
        )
        velocity = FilteredDifference(spec.control_dt, self.time)
        times = planner.rollout_times + task.dt
        return SimpleNamespace(planner=planner, velocity=velocity, times=times, count=0, status="")

    def step(self, observation: eq.Observation, reference: eq.Reference, s: SimpleNamespace) -> tuple[np.ndarray, Any]:
        q = np.asarray(observation.position)
        v = s.velocity(q)
        s.status = "held"
        if s.count % self.every == 0:
            wanted = np.array([reference.position(observation.time + t) for t in s.times])
            s.planner.system_metadata = {"wanted": wanted, "moving": np.gradient(wanted, s.times, axis=0)}
            s.planner.update_action(np.concatenate([q, v]), observation.time)
            s.status = "sampled"
        s.count += 1
        return np.asarray(s.planner.action(observation.time)), s


PEERS: Mapping[str, type] = {"python-control": ControlLqr, "do-mpc": DoMpc, "judo": Judo}


def lines_of(peer: str) -> int:
    """How many lines of code a peer's user writes: its wrapper's and the filter's, no comments, no docstrings."""
    return sum(code_lines(inspect.getsource(part)) for part in (PEERS[peer], FilteredDifference))


def code_lines(source: str) -> int:
    """Lines of a source that hold code: no blank ones, comments or docstrings."""
    lines: set[int] = set()
    begins = True
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type in (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT):
            begins = True
        elif token.type in (tokenize.NL, tokenize.COMMENT, tokenize.ENDMARKER):
            continue
        elif not (begins and token.type == tokenize.STRING):
            lines.update(range(token.start[0], token.end[0] + 1))
            begins = False
    return len(lines)


def version(peer: str) -> str:
    """Of the package that a peer comes with; empty where it is not installed."""
    try:
        return metadata.version(PACKAGES[peer])
    except metadata.PackageNotFoundError:
        return ""


def missing(peer: str) -> str:
    """Why a peer cannot take part, as a sentence; empty where it can."""
    if not version(peer):
        return f"{peer} is not installed (pip install -e '.[peers]')"
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            __import__({"python-control": "control", "do-mpc": "do_mpc", "judo": "judo.controller"}[peer])
    except Exception as error:  # what a package does as it is imported is its own
        return f"{peer} {version(peer)} cannot be imported: {type(error).__name__}: {str(error)[:120]}"
    return ""
