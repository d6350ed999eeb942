"""Laws in the place of one that is a special case of them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pendulum_runs import recorded

from equimus_ctrl.diagnosis.alternatives import simpler_laws
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part
from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.diagnosis.richer_laws import holds, richer
from equimus_ctrl.diagnosis.torque_guesses import far_above_noise
from equimus_ctrl.diagnosis.torque_screening import torque_domain
from equimus_ctrl.diagnosis.torque_start import laws_asked_for
from equimus_ctrl.effects import (
    AsymmetricFriction,
    CoulombFriction,
    DirectionalLoadFriction,
    Effect,
    FrictionWarmup,
    LoadFriction,
    PayloadMass,
    PositionDependentFriction,
    SpringTether,
    TetherWithFreeLength,
    ViscousFriction,
)
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

ARM = MjcfRobot(
    "arm",
    """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
      <body name="turn"><joint name="pan" axis="0 0 1" armature="0.1" damping="1"/>
        <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
        <body name="upper"><joint name="lift" axis="0 1 0" armature="0.1" damping="1"/>
          <inertial pos="0.15 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
          <body name="fore" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" armature="0.1" damping="1"/>
            <inertial pos="0.1 0 0" mass="0.5" diaginertia="0.005 0.005 0.005"/><site name="tip" pos="0.3 0 0"/>
    </body></body></body></worldbody><actuator><motor name="m1" joint="pan"/><motor name="m2" joint="lift"/>
      <motor name="m3" joint="elbow"/></actuator></mujoco>""",
)
PULLS = {"stiffness": 20.0, "x": 0.5, "y": 0.3, "z": 0.4}
LENGTH = 0.3


def test_a_law_holds_another_at_its_places_with_more_parameters() -> None:
    tether, longer = (Candidate(law, ("tip",), ()) for law in (SpringTether, TetherWithFreeLength))
    assert holds(longer, tether) and not holds(tether, longer) and not holds(tether, tether)
    assert not holds(longer, replace(tether, locations=("fore",)))
    assert not holds(*(replace(law, locations=("tip", "fore")) for law in (longer, tether)))
    assert not holds(longer, Candidate(PayloadMass, ("tip",), ()))  # another slot
    both, same = (Candidate(law, ("pan",), ()) for law in (DirectionalLoadFriction, LoadFriction))
    assert holds(both, same) and not holds(same, both)  # with the same share in both directions
    rough, dry = (Candidate(law, ("pan",), ()) for law in (PositionDependentFriction, CoulombFriction))
    assert holds(rough, dry)


@pytest.mark.parametrize(
    ("law", "simpler", "begun"),
    [
        (DirectionalLoadFriction, {"share": 0.1}, {"drive": 0.1, "backdrive": 0.1}),
        (AsymmetricFriction, {"friction": 0.2}, {"forward": 0.2, "backward": 0.2}),
        (PositionDependentFriction, {"friction": 0.2}, {"friction": 0.2, "more": 0.5, "angle": 1.0}),
    ],
)
def test_a_law_begins_as_the_one_that_it_holds(
    law: type[Effect], simpler: dict[str, float], begun: dict[str, float]
) -> None:
    assert (
        law.begun_at(simpler, [dict.fromkeys(begun, 0.5) | {"angle": 1.0} if "angle" in begun else begun])[0] == begun
    )


def test_the_simpler_law_begins_between_the_sizes_of_the_richer_one() -> None:
    rich, simple = (Candidate(law, ("pan",), ()) for law in (AsymmetricFriction, CoulombFriction))
    simple = replace(simple, guesses=({"friction": 9.0},))
    search: Any = SimpleNamespace(allowed_candidates=lambda tried: [rich, simple])
    state: Any = SimpleNamespace(tried=None, best=SimpleNamespace(labels={rich.label}))
    (part,) = simpler_laws(search, state, Part(rich, {"forward": 0.1, "backward": 0.3}))
    assert part.candidate.effect is CoulombFriction and part.values == {"friction": pytest.approx(0.2)}


def test_what_a_law_tends_to_is_simpler_where_it_is_not_there_already() -> None:
    """Friction that fades far more slowly than recordings last is viscous friction, but not beside some."""
    fading, steady = (Candidate(law, ("pan",), ()) for law in (FrictionWarmup, ViscousFriction))
    steady = replace(steady, guesses=({"damping": 9.0},))
    search: Any = SimpleNamespace(allowed_candidates=lambda tried: [fading, steady])
    part = Part(fading, {"size": 3.0, "time_constant": 5e3})
    alone: Any = SimpleNamespace(tried=None, best=SimpleNamespace(labels={fading.label}))
    (simple,) = simpler_laws(search, alone, part)
    assert simple.candidate is steady and simple.values == {"damping": 3.0}
    both: Any = SimpleNamespace(tried=None, best=SimpleNamespace(labels={fading.label, steady.label}))
    assert simpler_laws(search, both, part) == []
    assert simpler_laws(search, alone, Part(steady, {"damping": 3.0})) == []


@lru_cache(maxsize=1)
def observed() -> tuple[Data, Candidate, Candidate]:
    """Of an arm that a spring with a free length pulls, and the laws of springs without one and with one."""
    nominal = Model(ARM)
    real = replace(nominal, effects=(TetherWithFreeLength("tip", **PULLS, length=LENGTH),))
    segments = cut(nominal, recorded(real, count=2, seconds=4.0, size=3.0, dt=0.01), shoot=2.0)
    data = Data(free_parameters(nominal, ["fore.mass"]), list(segments), reduced_simulator(threads=1))
    seen = excitation_of(nominal, segments)["tip"]
    laws = (Candidate(law, ("tip",), tuple(law.guesses(seen))) for law in (SpringTether, TetherWithFreeLength))
    return data, *laws


def test_a_free_length_is_found_from_the_spring_without_one() -> None:
    """From what was fitted of the simpler law."""
    data, simple, rich = observed()
    noise, starts = white_noise([np.full((9, 3), 5e-4)]), [s.start for s in data.segments]
    begin = data.theta_of(data.free.start, (Part(simple, PULLS),))
    fitted = data.coarse_fit((Part(simple, PULLS),), [(begin, starts)], noise, 30)
    ((hypothesis, begins),) = richer(data, fitted, [rich, simple, Candidate(CoulombFriction, ("pan",), ())])
    assert [part.candidate for part in hypothesis] == [rich] and len(begins) == 13
    found = data.coarse_fit(hypothesis, begins, noise, 30)
    assert found.hypothesis[0].values == pytest.approx({**PULLS, "length": LENGTH}, rel=0.02)
    assert fitted.deviance - found.deviance > 1e3


@pytest.mark.slow
def test_the_torque_domain_finds_both_ends_of_a_spring() -> None:
    """No law that is linear in its size explains it, and all parameters of a spring are fitted then."""
    data, simple, rich = observed()
    pool = [simple, rich, Candidate(CoulombFriction, ("pan",), ({"friction": 0.5},))]
    domain = torque_domain(data, pool)
    assert domain is not None
    ((part,), _) = laws_asked_for(data, domain, pool, 3)
    assert part.candidate is rich
    assert part.values == pytest.approx({**PULLS, "length": LENGTH}, rel=0.1)
    assert not far_above_noise(data, domain, np.full(3, 1e-3)) and far_above_noise(data, domain, np.full(3, 10.0))
