"""Plans that may look where they lead: raise energy, then follow a spline, then leave the rest to a regulator.

    u = s h sign(Bᵀv) sat((E* − E)/(g ΔE))      until a time tₚ
        w(t) + spline(t)                        from then on
        w(t) − K (x − x*(t))                    from a time tᵣ on

When one hands over to the next, how strong the first is and which regulator comes last is sampled along with the
spline's knots, and rolled out with all limits: what a phase comes to is known before it begins, and no threshold begins
one. The regulator is that of the sampled linear model about where the robot is to be, dead times included.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, expm, solve_discrete_are

from equimus_ctrl.effects.command import DELAY, FILL, FLOW, RATE, VENT, pressure_rollouts
from equimus_ctrl.models.dynamics import Linear
from equimus_ctrl.predictive.energy import Energy
from equimus_ctrl.predictive.forward import Forward
from equimus_ctrl.predictive.measures import Measures
from equimus_ctrl.predictive.splines import Spline
from equimus_ctrl.types import Array

NEAR = 0.05
"""g: share of ΔE from the wanted energy within which energy is raised less than fully."""
STILL = 1e-6
"""Share of the natural rate below which nothing moves, and no command raises energy."""
LINE = 1e-9
"""Share of a period that is none."""


@dataclass(frozen=True, eq=False)
class Plans:
    """(n,) plans.

    Attributes:
        knots: (n, k, na) of their splines, in shares of ``Measures.command``.
        raised: (n,) tₚ, until when energy is raised, from now on [s]; -inf for not at all.
        strength: (n,) s, with which share of the commands' range.
        settled: (n,) tᵣ, from when the regulator has it [s]; inf for never.
        regulator: (n,) which.
    """

    knots: Array
    raised: Array
    strength: Array
    settled: Array
    regulator: NDArray[np.int64]

    @classmethod
    def none(cls, knots: int, actuators: int) -> Plans:
        """The one plan of what the reference asks for."""
        one = np.ones(1)
        return cls(np.zeros((1, knots, actuators)), -np.inf * one, one, np.inf * one, np.zeros(1, dtype=np.int64))

    def one(self, k: int, knots: Array | None = None) -> Plans:
        """The k-th of them, perhaps with other knots (k, na)."""
        own = slice(k, k + 1)
        held = self.knots[own] if knots is None else np.asarray(knots)[None]
        return Plans(held, self.raised[own], self.strength[own], self.settled[own], self.regulator[own])

    def later(self, by: float, spline: Spline) -> Plans:
        """The same as seen a time later [s]."""
        moved = spline.matrix(spline.times + by)
        return replace(self, knots=moved @ self.knots, raised=self.raised - by, settled=self.settled - by)


def drawn(rng: np.random.Generator, nominal: Plans, knots: Array, horizon: float, raises: bool, settles: int) -> Plans:
    """Plans about a nominal one, which is the first; those after it leave all to one of the regulators at once.

    Of the others half differ from the nominal one in their knots alone. The rest also hand over at other times: to a
    regulator, at any or about when the nominal one does; or once energy was raised for a while.

    Args:
        rng: of the draws.
        nominal: the one.
        knots: (n, k, na) of theirs, the nominal one's first.
        horizon: [s].
        raises: whether energy can be raised.
        settles: how many regulators there are.
    """
    n = len(knots)
    any_time, a, b = rng.random((3, n))
    about, which = rng.standard_normal(n), rng.integers(max(settles, 1), size=n)
    raised, strength = np.repeat(nominal.raised, n), np.repeat(nominal.strength, n)
    settled, regulator = np.repeat(nominal.settled, n), np.repeat(nominal.regulator, n)
    kind = np.arange(n) % 8
    if settles:
        anew = kind == 4
        near = settled + about * horizon / knots.shape[1]
        settled = np.where(
            anew | (kind == 5) & ~np.isfinite(settled), any_time * horizon, np.where(kind == 5, near, settled)
        )
        regulator = np.where((kind == 4) | (kind == 5), which, regulator)
    if raises:
        fresh = kind >= 6
        raised = np.where(fresh, 1.2 * horizon * any_time, raised)
        strength = np.where(fresh, np.where(kind == 6, 1.0, a), strength)
        settled = np.where(fresh, np.where(b < 0.5, raised + a * horizon, np.inf), settled)
        settled = np.where(fresh & (settles == 0), np.inf, settled)
    first = slice(1, 1 + settles)
    settled[first], raised[first], regulator[first] = 0.0, -np.inf, np.arange(settles)[: n - 1]
    for own, held in ((raised, nominal.raised), (strength, nominal.strength), (settled, nominal.settled)):
        own[0] = held[0]
    regulator[0] = nominal.regulator[0]
    return Plans(knots, raised, strength, settled, regulator)


class Valves:
    """What arrives of commands: dead times in parts of a control period, lags and rates.

    Args:
        valve: (na, 6), see ``effects.command.DELAY``.
        period: of control [s].
        shaped: what reaches the valves of commands (n, na); by default these.

    Attributes:
        memory: how many commands before the latest still count.
    """

    def __init__(
        self, valve: Array, period: float, shaped: Callable[[Array], Array] = lambda commands: commands
    ) -> None:
        self.shaped = shaped
        late = valve[:, DELAY] / period
        self._whole = np.floor(late + LINE).astype(int)
        self._rest = np.maximum(late - self._whole, 0.0) * (late - self._whole > LINE)
        self.memory = int((self._whole + (self._rest > 0)).max(initial=0))
        self._valve, self._period = valve.copy(), period
        self._shares = self.weights()
        self.lagging = bool(
            np.any(valve[:, [FILL, VENT]] > 0) or np.any(np.isfinite(valve[:, [RATE, FLOW]]))
        )  # fmt: skip

    def weights(self) -> Array:
        """(memory + 1, na) the share of each command, the oldest first, in what arrives over a period."""
        found = np.zeros((self.memory + 1, len(self._whole)))
        for i, (whole, rest) in enumerate(zip(self._whole, self._rest, strict=True)):
            found[self.memory - whole, i] += 1 - rest
            if rest > 0:
                found[self.memory - whole - 1, i] += rest
        return found

    def arriving(self, sent: Array) -> Array:
        """(n, na) the mean over a period of what reaches the valves of commands (n, memory + 1, na), oldest first."""
        if not self.memory:
            return self.shaped(sent[:, 0])
        rows = self.shaped(sent.reshape(-1, sent.shape[2])).reshape(sent.shape)
        return np.asarray(np.einsum("nka,ka->na", rows, self._shares))

    def through(self, behind: Array, arriving: Array) -> tuple[Array, Array]:
        """Mean over a period behind valves, and at its end, (n, na) each, of what was behind them before."""
        if not self.lagging:
            return arriving, arriving
        n, na = arriving.shape
        means, ends = np.empty((1, 1, n * na)), np.empty((1, 2, n * na))
        valve = np.tile(self._valve, (n, 1))
        pressure_rollouts(behind.ravel(), arriving.reshape(1, 1, -1), valve, self._period, means, ends)
        return means.reshape(n, na), ends[0, 1].reshape(n, na)


@dataclass(frozen=True, eq=False)
class Settler:
    """A regulator about a pose.

    Attributes:
        gain: (na, 2 nj + m na) on the errors of positions and rates, then of commands under way, the oldest first.
        cost: (2 nj, 2 nj) P: from an error e on all costs ½ eᵀ P e.
    """

    gain: Array
    cost: Array


def settler(linear: Linear, valves: Valves, period: float, scale: Array, command: Array) -> Settler | None:
    """The regulator that minimises Σ ½ (|e/scale|² + |δu/command|²) T; None where the pose cannot be made stable.

    Args:
        linear: the robot about the pose.
        valves: what arrives of its commands.
        period: T, of control [s].
        scale: (2 nj,) of errors.
        command: (na,) of efforts.
    """
    a, b = linear.matrices()
    n, na, m = len(a), b.shape[1], valves.memory
    whole = expm(np.block([[a, b], [np.zeros((na, n + na))]]) * period)
    shares = valves.weights()
    full_a, full_b = np.zeros((n + m * na, n + m * na)), np.zeros((n + m * na, na))
    full_a[:n, :n] = whole[:n, :n]
    for k in range(m):
        own = slice(n + k * na, n + (k + 1) * na)
        full_a[:n, own] = whole[:n, n:] * shares[k]
        if k + 1 < m:
            full_a[own, own.stop : own.stop + na] = np.eye(na)
    full_b[:n] = whole[:n, n:] * shares[m]
    if m:
        full_b[-na:] = np.eye(na)
    q = np.zeros_like(full_a)
    q[:n, :n] = np.diag(period / scale**2)
    r = np.diag(period / command**2)
    try:
        cost = solve_discrete_are(full_a, full_b, q, r)
    except (LinAlgError, ValueError):
        return None
    gain = np.linalg.solve(r + full_b.T @ cost @ full_b, full_b.T @ cost @ full_a)
    if not np.abs(np.linalg.eigvals(full_a - full_b @ gain)).max() < 1:
        return None
    return Settler(gain, cost[:n, :n])


@dataclass(frozen=True, eq=False)
class Path:
    """Where the robot is to be, and under what commands.

    Attributes:
        states: (steps + 1, 2 nj) positions and rates wanted.
        feed: (steps, na) commands that they ask for.
        energy: at the end of it [J]; nan where energy takes no part.
    """

    states: Array
    feed: Array
    energy: float

    def after(self, k: int) -> Path:
        """What is left of it after some control periods."""
        return Path(self.states[k:], self.feed[k:], self.energy)


@dataclass(frozen=True, eq=False)
class Policies:
    """Plans and a robot to try them on.

    Attributes:
        forward: the robot.
        valves: what arrives of its commands.
        measures: its scales.
        spline: of plans.
        period: of control [s].
        low: (na,) lowest commands.
        high: (na,) highest.
        settlers: regulators that plans may end with.
        energy: of the robot, where raising it is a way; None where it is none.
        span: ΔE [J].
    """

    forward: Forward
    valves: Valves
    measures: Measures
    spline: Spline
    period: float
    low: Array
    high: Array
    settlers: Sequence[Settler]
    energy: Energy | None
    span: float

    def commands(self, plans: Plans, at: float, x: Array, under_way: Array, path: Path, spline: Array) -> Array:
        """(n, na) what plans command as the path begins.

        Args:
            plans: (n,) of them.
            at: how long after they begin [s].
            x: (n, 2 nj) positions and rates then.
            under_way: (n, m, na) commands before it, the oldest first.
            path: of which the first row counts.
            spline: (n, na) of theirs, in shares.
        """
        own, feed = self.measures, path.feed[0]
        asked = feed + own.command * spline
        if self.settlers:
            settling = np.flatnonzero(plans.settled <= at + LINE * self.period)
            if len(settling):
                late = (under_way[settling] - feed).reshape(len(settling), -1)
                off = np.concatenate([own.errors(x[settling], path.states[0]), late], axis=1)
                gains = self.gains[plans.regulator[settling]]
                asked[settling] = feed - np.einsum("nij,nj->ni", gains, off)
        if self.energy is not None:
            raising = np.flatnonzero(plans.raised > at + LINE * self.period)
            if len(raising):
                asked[raising] = self._raised(x[raising], plans.strength[raising], path.energy)
        return np.asarray(np.clip(asked, self.low, self.high))

    def _raised(self, x: Array, strength: Array, wanted: float) -> Array:
        """(n, na) commands that bring the energy of states (n, 2 nj) to what is wanted [J]."""
        own = self.measures
        assert self.energy is not None  # else nothing raises it
        energy, power = self.energy(x)
        lacking = np.clip((wanted - energy) / (NEAR * self.span), -1.0, 1.0)
        power = power * own.command
        ways = power / (np.abs(power) + STILL * np.abs(power).max(initial=1.0))
        return np.asarray(own.middle + own.command * (strength * lacking)[:, None] * ways)

    @cached_property
    def gains(self) -> Array:
        """(regulators, na, 2 nj + m na)."""
        return np.array([settler.gain for settler in self.settlers])

    def splines(self, plans: Plans, times: Array) -> Array:
        """(n, k, na) of plans over control periods that begin at times (k,) after they do [s], in shares."""
        return np.asarray(self.spline.matrix(times + self.period / 2) @ plans.knots)

    def rolled(self, plans: Plans, state: Array, behind: Array, under_way: Array, path: Path) -> tuple[Array, Array]:
        """(n, steps + 1, 2 nj) where plans lead, nan from where a rollout is lost, and (n, steps, na) their commands.

        Args:
            plans: (n,) of them.
            state: (nx,) of the robot now.
            behind: (na,) what is behind its valves.
            under_way: (m, na) commands that may still be on their way, the oldest first.
            path: where the robot is to be.
        """
        n, steps, m = len(plans.knots), len(path.feed), self.valves.memory
        na = path.feed.shape[1]
        states, held = np.tile(state, (n, 1)), np.tile(behind, (n, 1))
        sent = np.empty((n, m + steps, na))
        sent[:, :m] = under_way
        x = self.forward.joints(states)
        times = np.asarray(self.period * np.arange(steps), dtype=np.float64)
        along = self.splines(plans, times)
        found = np.empty((n, steps + 1, x.shape[1]))
        found[:, 0] = x
        for k in range(steps):
            late, rest = sent[:, k : k + m], path.after(k)
            sent[:, m + k] = self.commands(plans, times[k], x, late, rest, along[:, k])
            mean, held = self.valves.through(held, self.valves.arriving(sent[:, k : k + m + 1]))
            states = self.forward(states, mean)
            found[:, k + 1] = x = self.forward.joints(states)
        return found, sent[:, m:]
