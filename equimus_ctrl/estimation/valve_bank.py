"""Dead times and lags of valves that nobody told of, from commands and positions: a bank of Kalman filters.

Each actuator has hypotheses of how much later its valve is than is known. About its estimate the filter is linear, so
that the filter of other valves differs from it by a sum of one deviation for each actuator,

    δ ← F δ + G (P_h − P),    δ ← (1 − K H) δ,    ν_h = ν − Σ H δ,

P being what has passed the valves, F and G how a step carries state and pressures on, K the filter's gain and ν what a
measurement differs by from what was expected. All filters share their covariances, so that with s the variance of ν

    −2 ln L_h = Σ ν_h²/s + what all have in common

(multiple models, Magill, "Optimal adaptive estimation of sampled stochastic processes", IEEE Transactions on Automatic
Control 10, 1965). One filter is run; the others take a product of matrices.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.effects.command import DELAY, FILL, VENT
from equimus_ctrl.effects.valves import ValveEffect, valve_effects, valve_settings
from equimus_ctrl.estimation import bank_kernel
from equimus_ctrl.estimation.bank_kernel import SMALL
from equimus_ctrl.models.linear import valve_lag
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.solved import valves_of
from equimus_ctrl.types import Array

PARTS = 4
"""Into which the usual dead time and the usual lag are divided: valves are known to an eighth of these."""
CHANCE = 1e-3
"""With which noise alone makes any hypothesis look so much better than the one in force (Bonferroni over all)."""
EXPLAINED = 0.5
"""Share of what the known valves leave of Σ ν²/s beyond its expectation that others have to explain: most of it, or
something else is missing, a push say, of which later valves explain a little by chance."""


@dataclass(frozen=True, eq=False)
class Sent:
    """Commands that may still be on their way.

    Attributes:
        times: (n,) from when each was in force [s].
        values: (n, na) what reaches the valves of them, see ``effects.valves.shaped_commands`` [Pa].
    """

    times: Array
    values: Array

    @cached_property
    def instants(self) -> list[float]:
        """``times`` as Python's numbers, of which single ones are read faster."""
        return self.times.tolist()  # type: ignore[no-any-return]

    def at(self, time: float, actuator: int) -> float:
        """In force at a time, the first before all [Pa]."""
        k = bisect_right(self.instants, time + SMALL) - 1
        return float(self.values[max(k, 0), actuator])


@dataclass(eq=False)
class Carried:
    """How an interval carries a filter's state on; grows with its parts, see ``filter_kernel.carried_on``.

    Attributes:
        state: (m, m) F.
        pressure: (m, na) G, of pressures that differ over all of it.
    """

    state: Array
    pressure: Array

    @classmethod
    def nothing(cls, m: int, na: int) -> Carried:
        """Of no time."""
        return cls(np.eye(m), np.zeros((m, na)))


@dataclass(frozen=True, eq=False)
class BankState:
    """What a bank remembers, its k hypotheses of each of na actuators one after the other.

    Attributes:
        deviation: (m, na k) δ.
        pressure: (na, k) behind the valves [Pa].
        fits: (na k,) Σ ν Hδ/s.
        alike: (na k, na k) Σ Hδ (Hδ)ᵀ/s.
        total: Σ ν²/s of the filter that is run.
        count: of measurements.
        choice: (na,) the hypothesis in force of each actuator.
    """

    deviation: Array
    pressure: Array
    fits: Array
    alike: Array
    total: float
    count: int
    choice: tuple[int, ...]


class ValveBank:
    """Hypotheses of one model's valves: each dead time with each lag, from what is known to what is usual.

    Args:
        model: what is known of the robot.

    Attributes:
        late: (na, k, 2) further dead time and lag of each hypothesis, the first none [s].
        longest: further dead time, at most [s].
        is_open: whether anything can be later than is known.
        lags: whether lags can; dead times take no part in a step of the model.
    """

    def __init__(self, model: Model) -> None:
        valve, traits = valves_of(model), model.robot.traits
        known = np.stack([valve[:, DELAY], valve_lag(valve)], axis=1)
        room = np.maximum(np.array([traits.usual_delay, traits.usual_lag]) - known, 0.0)
        share = np.linspace(0.0, 1.0, PARTS + 1)
        ways = (share if wide else share[:1] for wide in room.max(axis=0) > 0)
        each = np.array(list(itertools.product(*ways)))
        self.late: Array = room[:, None] * each
        self.longest = float(room[:, 0].max(initial=0.0))
        self.is_open, self.lags = bool(room.any()), bool(room[:, 1].any())
        self._count = len(each)
        self._alternatives = float(self._count) ** len(valve)
        self._model = model
        self._whole: Array = known[:, None] + self.late

    def begin(self, m: int, pressure: Array) -> BankState:
        """A robot that has long been at rest.

        Args:
            m: states of the filter, unknown torques included.
            pressure: (na,) [Pa].
        """
        na, k = len(pressure), self._count
        own = np.repeat(pressure[:, None], k, axis=1)
        return BankState(np.zeros((m, na * k)), own, np.zeros(na * k), np.zeros((na * k, na * k)), 0.0, 0, (0,) * na)

    def carried(self, state: BankState, by: Carried, start: float, until: float, sent: Sent) -> BankState:
        """Over an interval without a measurement.

        Args:
            state: at its begin.
            by: how it carries the filter on.
            start: its begin [s].
            until: its end [s].
            sent: the commands of up to ``longest`` and the valves' delay before.
        """
        if until <= start + SMALL:
            return state
        na, k = state.pressure.shape
        mean, pressure = np.empty((na, k)), np.empty((na, k))
        bank_kernel.passed(sent.times, sent.values, start, until, self._whole, state.pressure, pressure, mean)
        other = mean - mean[:, :1]
        deviation = by.state @ state.deviation + (by.pressure[:, :, None] * other).reshape(len(by.state), na * k)
        return replace(state, deviation=deviation, pressure=pressure)

    def corrected(self, state: BankState, row: Array, gain: Array, off: float, variance: float) -> BankState:
        """After a measurement.

        Args:
            state: before.
            row: (m,) H.
            gain: (m,) K.
            off: ν.
            variance: s.
        """
        deviation, fits, alike = state.deviation.copy(), state.fits.copy(), state.alike.copy()
        bank_kernel.seen(row, gain, off, variance, deviation, fits, alike)
        return replace(
            state, deviation=deviation, fits=fits, alike=alike, total=state.total + off**2 / variance,
            count=state.count + 1,
        )  # fmt: skip

    def chosen(self, state: BankState) -> BankState:
        """With the likeliest hypothesis in force, where the one that was is too unlikely for chance.

        Where none explains what is measured, the model lacks something else; what that makes of ν is then the noise.
        The known valves stay in force until later ones explain most of what they leave.
        """
        k, na = self._count, len(state.choice)
        sums = state.fits, state.alike
        # The likeliest is looked for from that in force, and from the likeliest of those alike for all actuators.
        begins = state.choice, (bank_kernel.alike_for_all(*sums, na, k),) * na
        found = [np.array(begin) for begin in begins]
        costs = [bank_kernel.improved(state.total, *sums, begin, k) for begin in found]
        first = int(np.argmin(costs))
        best = tuple(found[first].tolist()), costs[first]
        cost = state.total + bank_kernel.unlikely(*sums, np.array(state.choice), k)
        least = 2 * math.log(self._alternatives / CHANCE) * max(best[1] / max(state.count, 1), 1.0)
        if not any(state.choice):
            least = max(least, EXPLAINED * (cost - state.count))
        return replace(state, choice=best[0]) if cost - best[1] > least else state

    def deviation(self, state: BankState) -> Array:
        """(m,) by how much the state of the filter of the hypothesis in force differs."""
        return np.asarray(state.deviation[:, self._columns(state.choice)].sum(axis=1))

    def pressures(self, state: BankState) -> Array:
        """(na,) behind the valves of the hypothesis in force [Pa]."""
        return np.asarray(state.pressure[np.arange(len(state.pressure)), list(state.choice)])

    def model(self, choice: tuple[int, ...]) -> Model:
        """The model with the valves of a hypothesis."""
        if not any(choice):
            return self._model
        names, effects = self._model.robot.actuator_names, self._model.effects
        valve = valve_settings(effects, names)
        for row, late, own in zip(valve, self.late, choice, strict=True):
            row[DELAY] += late[own, 0]
            row[[FILL, VENT]] += late[own, 1]
        kept = [effect for effect in effects if not isinstance(effect, ValveEffect)]
        valves = [effect for row, name in zip(valve, names, strict=True) for effect in valve_effects(row, name)]
        return replace(self._model, effects=(*kept, *valves))

    def _columns(self, choice: tuple[int, ...]) -> NDArray[np.intp]:
        return np.array([i * self._count + own for i, own in enumerate(choice)], dtype=np.intp)
