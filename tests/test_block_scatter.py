"""A gain has to stand out from how residuals scatter, where these are more than noise."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.stats import chi2, f
from search_on_paper import OFF, RUB, Known, OnPaper, ended, held_out_rejects

from equimus_ctrl.diagnosis import confirmation
from equimus_ctrl.diagnosis.block_scatter import BlockScatter, block_scatter, stands_out
from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.policy import SearchPolicy
from equimus_ctrl.diagnosis.screening import screen
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.identification.noise import JointNoise, white_noise
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording

ROWS, COLUMNS = 4000, 40
BLOCKS = round(Thresholds().blocks)
TIME = 0.01 * np.arange(ROWS)


def waves(rng: np.random.Generator, count: int) -> Array:
    """(ROWS, count) slow motions of half a second to three: what laws change, and what is left of them, looks so."""
    turns = rng.uniform(0.3, 2.0, (count, 6)) * 2 * np.pi
    own = np.sin(TIME[:, None, None] * turns + rng.uniform(0, 6, (count, 6))).sum(axis=2)
    return np.asarray(own * np.exp(-((TIME[:, None] - rng.uniform(0, TIME[-1], count)) ** 2) / 200))


def fits(residual: Array, column: Array) -> tuple[Fitted, Fitted, float]:
    """Without and with a column (n,) fitted to a residual (n,), the noise as large as what is left; −2Δln L."""
    left = residual - column * float(column @ residual / (column @ column))
    size = float(np.sqrt((left**2).mean()))
    pair: Any = [
        SimpleNamespace(noise=(JointNoise(size),), fit=SimpleNamespace(residuals=[own[:, None]]))
        for own in (residual, left)
    ]
    return pair[0], pair[1], len(residual) * float(np.log((residual**2).sum() / (left**2).sum()))


def best_of_many(rng: np.random.Generator, residual: Array) -> tuple[BlockScatter, float]:
    """Of candidates that say nothing of a residual the scatter of the one that gains most, and its gain."""
    columns = waves(rng, COLUMNS)
    gains = (columns.T @ residual) ** 2 / (columns**2).sum(axis=0)
    simple, rich, gain = fits(residual, columns[:, int(np.argmax(gains))])
    return block_scatter([TIME], simple, rich, BLOCKS), gain


@pytest.mark.slow
def test_what_gains_on_what_laws_leave_does_not_stand_out_from_it() -> None:
    """Residuals of twice the noise that last: nearly every search over them gains more than noise ever would."""
    least = chi2.isf(Thresholds().significance / COLUMNS, 1)
    gained = stood_out = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        left = waves(rng, 40).sum(axis=1)
        residual = rng.normal(0, 1, ROWS) + 2 * left / left.std()
        scatter, gain = best_of_many(rng, residual)
        gained += gain > least
        stood_out += gain > least and stands_out(scatter, 1, COLUMNS, Thresholds()) > 1
    assert gained > 40 and stood_out <= 2


def test_on_noise_alone_only_the_gain_counts() -> None:
    judged = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        scatter, _ = best_of_many(rng, rng.normal(0, 1, ROWS))
        judged += np.isfinite(stands_out(scatter, 1, COLUMNS, Thresholds()))
        assert scatter.dispersion < 2.5
    assert judged == 0


@pytest.mark.parametrize("seed", range(5))
def test_an_effect_as_large_as_what_laws_leave_stands_out(seed: int) -> None:
    """It changes as much as is left."""
    rng = np.random.default_rng(seed)
    left, change = waves(rng, 40).sum(axis=1), waves(rng, 1)[:, 0]
    change *= 2 * np.sqrt(ROWS) / np.linalg.norm(change)
    residual = rng.normal(0, 1, ROWS) + 2 * left / left.std() + change
    simple, rich, _ = fits(residual, change)
    assert stands_out(block_scatter([TIME], simple, rich, BLOCKS), 1, COLUMNS, Thresholds()) > 1


def test_the_statistic_is_that_of_clustered_standard_errors() -> None:
    """Of a slope through the origin, by the definition of the sandwich, with blocks of equal information."""
    rng = np.random.default_rng(7)
    column = np.repeat(rng.choice([-1.0, 1.0], 24 * 50), 2)
    residual = 0.1 * column + np.repeat(rng.normal(0, 1, 24), 100) * column + rng.normal(0, 1, 2400)
    simple, rich, _ = fits(residual, column)
    found = block_scatter([0.01 * np.arange(2400)], simple, rich, 24)
    slope = column @ residual / (column @ column)
    scores = ((residual - slope * column) * column).reshape(24, 100).sum(axis=1)
    error = np.sqrt((scores**2).sum() * 24 / 23) / (column @ column)
    assert found.freedom == pytest.approx(23)
    assert found.statistic == pytest.approx((slope / error) ** 2)
    assert found.dispersion > 10 and found.more_than_noise(1e-3)
    assert found.needed(1e-3, 2) == pytest.approx(2 * f.isf(1e-3, 2, 23))


def test_a_change_of_a_few_moments_has_as_many_blocks_and_one_of_a_sample_none() -> None:
    rng = np.random.default_rng(3)
    brief = np.where((TIME > 4.0) & (TIME < 4.8), np.sin(20 * TIME), 0.0)
    assert block_scatter([TIME], *fits(brief + rng.normal(0, 0.1, ROWS), brief)[:2], BLOCKS).freedom > 15
    once = np.zeros(ROWS)
    once[1234] = 1.0
    alone = block_scatter([TIME], *fits(once + rng.normal(0, 0.1, ROWS), once)[:2], BLOCKS)
    assert not alone.more_than_noise(1e-3) and stands_out(alone, 1, COLUMNS, Thresholds()) == np.inf
    same = fits(rng.normal(0, 1, ROWS), np.ones(ROWS))[0]
    assert block_scatter([TIME], same, same, BLOCKS) == BlockScatter(1.0, 0.0, 0.0)


def test_what_is_lost_in_the_scatter_is_not_named_though_held_out_trials_improve(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = Known({(): 5000.0, (RUB,): 1000.0, (OFF,): 4800.0, (RUB, OFF): 900.0})
    held_out = held_out_rejects(monkeypatch, [])
    monkeypatch.setattr(confirmation, "_makes_worse", lambda *given: None)
    lost = confirmation.Confirmation("scatter", 5.13, stands_out=lambda t: 0.4)
    monkeypatch.setattr(
        confirmation, "_lost_in_scatter", lambda search, simple, rich: lost if OFF in rich.labels else None
    )
    said: dict[str, confirmation.Confirmation] = {}
    end = confirmation.confirmed(OnPaper(known), ended(known, RUB, OFF), held_out, said.__setitem__)
    assert end.best.labels == {RUB} and said[OFF] is lost and said[RUB].reason == "gain"
    assert "scatter 5.13 times as much" in str(lost)


GANTRY = """<mujoco model="gantry"><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="trolley"><joint name="rail" type="slide" axis="1 0 0" damping="2"/>
    <geom type="box" size=".1 .08 .05" mass="1.5"/>
    <body name="boom"><joint name="swing" axis="0 1 0" damping="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.35" size=".02" mass=".4"/>
      <body name="tool" pos="0 0 -.35"><joint name="wrist" axis="0 1 0" damping="0.01"/>
        <geom type="capsule" fromto="0 0 0 .15 0 -.1" size=".015" mass=".2"/></body></body></body></worldbody>
  <actuator><motor name="drive" joint="rail"/><motor name="hoist" joint="swing"/><motor name="tilt" joint="wrist"/>
  </actuator></mujoco>"""


def swung(seed: int, hard: bool) -> list[Recording]:
    """What another gantry does by MuJoCo, with dry friction that stops its boom, or as MuJoCo has it by default."""
    mj, rng = mujoco.MjModel.from_xml_string(GANTRY), np.random.default_rng(seed)
    names = ("drive", "hoist", "tilt"), ("rail", "swing", "wrist")
    mj.body_mass[1:] *= rng.uniform(0.92, 1.08, 3)
    mj.body_inertia[1:] *= rng.uniform(0.92, 1.08, (3, 1))
    mj.dof_frictionloss[1], mj.opt.timestep = 0.11, 2.5e-4
    if hard:
        mj.dof_solref[:], mj.dof_solimp[:] = (5e-4, 1.0), (0.9999, 0.9999, 0.001, 0.5, 2)
    found = []
    for k in range(4):
        data, rows = mujoco.MjData(mj), []
        turns, phase = 2 * np.pi * rng.uniform(0.2, 1.2, (3, 3)), rng.uniform(0, 6, (3, 3))
        for _ in range(801):
            command = (np.array([[1.0], [1 / 6], [0.04]]) * np.sin(turns * data.time + phase)).sum(axis=1)
            command[0] -= 4 * data.qpos[0] + 3 * data.qvel[0]
            noise = rng.normal(0, [5e-4, 1e-3, 1e-3])
            rows.append((data.time, *command, *(data.qpos + noise)))
            data.ctrl[:] = command
            mujoco.mj_step(mj, data, 40)
        table = np.array(rows)
        found.append(Recording(f"t{k}", table[:, 0], table[:, 1:4], table[:, 4:], *names))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("hard", [True, False])
def test_friction_that_creeps_while_it_sticks_is_no_gain_of_another_motor(hard: bool) -> None:
    model = Model(MjcfRobot("gantry", GANTRY))
    recordings = swung(90417, hard)
    free, parts = default_free_parameters(model), split(model, recordings, shoot=2.0)
    engine = engine_for(model, positions=[r.position for r in recordings])
    data = Data(free, parts.train, Simulator(engine, 1), policy=SearchPolicy.of(model.robot.traits, engine))
    pool = {own.label: own for own in candidates(model, parts.train)}
    search = Search(data, list(pool.values()))

    def with_one_more(fitted: Fitted, label: str) -> Fitted:
        (screened,) = screen(data, fitted, [pool[label]])
        begins = [(theta, fitted.fit.starts) for theta in screened.begins(data, fitted, True)]
        return data.converge(
            data.coarse_fit(screened.hypothesis, begins, white_noise(fitted.fit.residuals), search.settings.long_steps)
        )

    base = data.base()
    rubs = with_one_more(base, "coulomb_friction:swing")
    assert search.accepts(base, rubs) and confirmation._lost_in_scatter(search, base, rubs) is None
    stronger = with_one_more(rubs, "actuator_gain:tilt")
    said = confirmation._lost_in_scatter(search, rubs, stronger)
    if hard:
        assert rubs.deviance - stronger.deviance < 10 and said is None
        return
    # The gain is above the threshold of an effect, and explains a hundredth of the noise.
    assert search.accepts(rubs, stronger) and stronger.hypothesis[-1].values["factor"] == pytest.approx(1.011, abs=3e-3)
    assert said is not None and said.reason == "scatter" and said.found > 3
