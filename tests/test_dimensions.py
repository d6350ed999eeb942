"""In how many directions the parameters of a law change what is seen."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pendulum_runs import MOTOR, PENDULUM, recorded

from equimus_ctrl.diagnosis import fitting
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part
from equimus_ctrl.effects import DirectionalLoadFriction, Effect, LoadFriction, StribeckFriction
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array

TIME = np.linspace(0.01, 10, 400)
LOAD, RATE = np.cos(TIME), np.sin(3 * TIME)
OF_GAIN = 1e3 * LOAD[:, None]
"""What the model's own parameter does: it scales the load."""


def of_shares(values: dict[str, float]) -> Array:
    """Of friction by the load in either direction: its sign goes with the rate's times the load's."""
    drives = np.sign(RATE * LOAD) > 0
    size = -np.abs(LOAD) * np.sign(RATE)
    return 1e3 * np.stack(
        [np.where(drives, size, 0) * values["drive"], np.where(drives, 0, size) * values["backdrive"]], 1
    )


def of_stribeck(values: dict[str, float]) -> Array:
    fades = 1 / (1 + (RATE / values["velocity"]) ** 2)
    by_velocity = values["breakaway"] * fades**2 * 2 * RATE**2 / values["velocity"] ** 2
    by = (values["friction"] + 0 * RATE, values["breakaway"] * fades, by_velocity)
    return 1e3 * np.stack([np.sign(RATE) * one for one in by], 1)


def dimensions(
    monkeypatch: pytest.MonkeyPatch, law: type[Effect], slopes: Any, at: dict[str, float], *guesses: dict[str, float],
    most: int = 9, own: tuple[tuple[str, str], ...] = (),
) -> int:  # fmt: skip
    """Of a law whose derivatives are known, fitted to some values."""

    def as_it_is(self: Data, hypothesis: Hypothesis, *_: Any) -> Any:
        if hypothesis[-1].values.get("drive") == 0.9:
            raise SimulationDiverged("flies apart")
        return hypothesis[-1].values

    def whitened(times: Any, values: Any, noise: Any) -> Any:
        return SimpleNamespace(slopes=np.hstack([OF_GAIN, slopes(values)]))

    monkeypatch.setattr(fitting, "whiten_fit", whitened)
    monkeypatch.setattr(Data, "_fit", as_it_is)
    free: Any = SimpleNamespace(free=[None])
    part = Part(Candidate(law, ("hinge",), guesses, own=own), at)
    fit: Any = SimpleNamespace(theta=np.zeros(1), starts=[])
    fitted = Fitted((part,), fit, white_noise([np.ones((4, 1))]), 0.0)
    return Data(free, (), None).dimensions(fitted, 0, most)  # type: ignore[arg-type]


def test_what_the_model_s_own_parameters_do_is_no_dimension(monkeypatch: pytest.MonkeyPatch) -> None:
    """The difference of the shares is a gain: (−drive + backdrive)/2·load, and the sum is the friction."""
    shares = {"drive": 0.1, "backdrive": 0.2}
    assert dimensions(monkeypatch, DirectionalLoadFriction, of_shares, shares) == 1
    assert (
        dimensions(monkeypatch, StribeckFriction, of_stribeck, {"friction": 1.0, "breakaway": 1.0, "velocity": 0.5})
        == 3
    )


def test_where_a_fit_has_degenerated_the_law_is_no_simpler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a breakaway force Stribeck friction is Coulomb friction; where fits begin it is more."""
    ended = {"friction": 1.0, "breakaway": 0.0, "velocity": 10.0}
    begun = {"friction": 1.0, "breakaway": 1.0, "velocity": 0.5}
    assert dimensions(monkeypatch, StribeckFriction, of_stribeck, ended) == 1
    assert dimensions(monkeypatch, StribeckFriction, of_stribeck, ended, begun) == 3


def test_guesses_that_diverge_say_nothing_and_no_more_are_looked_at_than_decide(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shares = {"drive": 0.1, "backdrive": 0.2}
    assert dimensions(monkeypatch, DirectionalLoadFriction, of_shares, shares, {"drive": 0.9, "backdrive": 0.9}) == 1
    refused: dict[str, float] = {}  # would be a KeyError
    assert dimensions(monkeypatch, DirectionalLoadFriction, of_shares, shares, refused, most=0) == 1


def test_where_all_guesses_diverge_every_parameter_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    apart = {"drive": 0.9, "backdrive": 0.9}
    assert dimensions(monkeypatch, DirectionalLoadFriction, of_shares, apart, apart) == 2


def test_sizes_of_a_group_of_trials_begin_at_the_common_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the second half of the time, which is another group's, the breakaway force is that group's own."""

    def in_groups(values: dict[str, float]) -> Array:
        assert list(values) == ["friction", "breakaway", "velocity", "breakaway in b"]
        here = of_stribeck(values)
        there = of_stribeck({**values, "breakaway": values["breakaway in b"]})
        first = (TIME < 5)[:, None]
        whole = np.where(first, here, there)
        return np.hstack(
            [whole * [1, 1, 1] * np.where([False, True, False], first, True), np.where(first, 0, there[:, 1:2])]
        )

    ended = {"friction": 1.0, "breakaway": 0.0, "velocity": 10.0, "breakaway in b": 0.0}
    begun = {"friction": 1.0, "breakaway": 1.0, "velocity": 0.5}
    own = (("breakaway", "b"),)
    assert dimensions(monkeypatch, StribeckFriction, in_groups, ended, begun, own=own) == 4


@pytest.mark.slow
def test_a_share_backwards_is_a_dimension_where_masses_are_known() -> None:
    """A gain of all forces is a mass and an inertia; of an armature of 0.004 kg·m² it is not, by far too little."""
    nominal = Model(MjcfRobot("arm", PENDULUM.format(drive=MOTOR)))
    real = Model(nominal.robot, (LoadFriction("hinge", 0.1),))
    segments = cut(nominal, recorded(real, count=2, seconds=4.0, noise=5e-3), shoot=2.0)
    candidate = Candidate(DirectionalLoadFriction, ("hinge",), ({"drive": 0.05, "backdrive": 0.2},))
    found = []
    for names in (["arm.mass", "arm.inertia"], ["hinge.damping"]):
        data = Data(free_parameters(nominal, names), list(segments), reduced_simulator(threads=1))
        part = Part(candidate, {"drive": 0.1, "backdrive": 0.1})
        begin = (data.theta_of(data.free.start, (part,)), [s.start for s in segments])
        fitted = data.coarse_fit((part,), [begin], white_noise([np.full((9, 1), 5e-3)]), 10)
        found.append(data.dimensions(fitted, 0, 2))
    assert found == [1, 2]
