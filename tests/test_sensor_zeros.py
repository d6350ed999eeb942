"""Joint sensors whose zero is another, unknown one in each recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from mjcf_models import refusal
from pendulum_runs import MOTOR, PENDULUM, SERVO, recorded

from equimus_ctrl import workflow
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.hypothesis import Candidate
from equimus_ctrl.diagnosis.torque_screening import torque_domain, torque_screen
from equimus_ctrl.effects import CoulombFriction, Effect, SensorOffset, ViscousFriction
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.residuals import followed
from equimus_ctrl.identification.segments import LEAST_TRUST, cut
from equimus_ctrl.identification.simulators import simulator_for
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow.identifications import with_free_zeros

ARM = MjcfRobot("arm", PENDULUM.format(drive=MOTOR))
SERVO_ARM = MjcfRobot("arm", PENDULUM.format(drive=SERVO))
ZEROS = (0.04, -0.07, 0.02, 0.09)
"""[rad]"""


def shifted(trials: Sequence[Recording], zeros: Sequence[float] = ZEROS) -> list[Recording]:
    return [replace(t, position=t.position + zero) for t, zero in zip(trials, zeros, strict=True)]


def trials_of(*effects: Effect, robot: MjcfRobot = ARM, count: int = 4, **more: float) -> list[Recording]:
    return recorded(Model(robot, effects), count=count, **more)  # type: ignore[arg-type]


def test_masses_and_zeros_are_found_within_their_intervals() -> None:
    """Gravity tells where down is; a common zero would have to suit all trials."""
    trials = shifted(trials_of())
    model = Model(ARM).with_parameters({"arm.mass": 0.7})
    found = workflow.identify_recordings(
        trials, model, free=["arm.mass", "hinge.armature"], zero_per_trial=["hinge"], folds=0
    ).fit
    (mass, width), *_ = zip(found.theta, found.uncertainty.half_width, strict=True)
    assert abs(mass - 0.6) < max(width, 1e-3) < 0.02
    assert [(zero.recording, zero.joint, zero.unit) for zero in found.zeros] == [
        (f"t{k}", "hinge", "rad") for k in range(4)
    ]
    np.testing.assert_allclose([zero.value for zero in found.zeros], ZEROS, atol=2e-3)
    one = workflow.identify_recordings(
        trials,
        Model(model.robot, (SensorOffset("hinge", 0.0),)),
        free=["arm.mass", "hinge.armature", "*.offset"],
        folds=0,
    ).fit
    assert one.rmse[0] > 10 * found.rmse[0]


def test_a_zero_moves_what_is_shown_and_not_what_happens() -> None:
    """Of a sensor that has an effect of its own too: y = zero + offset + q."""
    model = Model(ARM, (SensorOffset("hinge", 0.2),))
    (plain,) = cut(model, trials_of(count=1))
    (segment,) = cut(model, with_free_zeros(trials_of(count=1), ["*"]))
    simulator = simulator_for(model)
    assert (plain.free_start, segment.free_start, segment.start_joints) == (2, 3, [0, 0, 0])
    assert segment.start_weights[-1] == LEAST_TRUST
    start = segment.start + np.array([0.0, 0.0, 0.3])
    (one,) = simulator([model], [segment], [start[None]])
    (other,) = simulator([model], [plain], [plain.start[None] - np.array([[0.3, 0.0]])])
    np.testing.assert_allclose(one.position, other.position + 0.3, atol=1e-12)


def test_starts_of_trials_held_out_take_their_zeros_along() -> None:
    trials = with_free_zeros(shifted(trials_of(count=2), ZEROS[:2]), ["hinge"])
    model = Model(ARM)
    starts, residuals = followed(model, cut(model, trials), simulator_for(model))
    np.testing.assert_allclose([start[2] for start in starts], ZEROS[:2], atol=3e-3)
    assert np.std(np.concatenate(residuals)) < 1e-3


@pytest.mark.slow
def test_missing_friction_is_found_beside_unknown_zeros_of_a_servo() -> None:
    """A servo's own encoder is off as the recorded one is not: where the goal is reached tells the zero."""
    trials = shifted(trials_of(CoulombFriction("hinge", 0.3), robot=SERVO_ARM, seed=3))
    found = workflow.diagnose(trials, Model(SERVO_ARM), free=["arm.mass"], zero_per_trial=["hinge"], most=1, threads=1)
    assert [(f.named.effect, f.named.locations) for f in found.findings] == [("coulomb_friction", ("hinge",))]
    assert found.findings[0].parameters["friction"].value == pytest.approx(0.3, abs=0.01)
    fitted = {zero.recording: zero.value for zero in found.best.fit.zeros}
    np.testing.assert_allclose([fitted[name] for name in fitted], [ZEROS[int(name[1:])] for name in fitted], atol=3e-3)
    assert any(note.startswith("Zeros of the sensors") and "t0 hinge +0.0" in note for note in found.notes)
    assert found.to_dict()["zeros"][0]["joint"] == "hinge"


def test_zeros_are_projected_out_in_the_torque_domain() -> None:
    """What friction explains there does not depend on how far the zeros are off."""
    pool = [Candidate(ViscousFriction, ("hinge",), ({"damping": 0.1},))]
    sizes = []
    for trials in (trials_of(ViscousFriction("hinge", 0.2)), shifted(trials_of(ViscousFriction("hinge", 0.2)))):
        model = Model(ARM)
        segments = cut(model, with_free_zeros(trials, ["hinge"]))
        data = Data(free_parameters(model, ["hinge.armature"]), segments, simulator_for(model))
        domain = torque_domain(data, pool)
        assert domain is not None
        (fit,) = torque_screen(data, domain, None, pool).alone().values()
        sizes.append(fit.values["damping"])
    assert sizes[0] == pytest.approx(0.2, abs=0.02)
    assert sizes[1] == pytest.approx(sizes[0], abs=2e-3)


WRONG = [
    ({"zero.hing": "free"}, "note zero.hing: there is no joint 'hing'; did you mean 'hinge'?"),
    ({"zero.hinge": "0.3"}, "note zero.hinge is '0.3', expected free"),
]


@pytest.mark.parametrize(("notes", "message"), WRONG, ids=[str(notes) for notes, _ in WRONG])
def test_a_note_that_says_nothing_usable_is_told(notes: dict[str, str], message: str) -> None:
    (trial,) = trials_of(count=1, seconds=1.0)
    assert message in refusal(lambda: cut(Model(ARM), [replace(trial, notes=notes)]))


def test_a_joint_that_is_none_and_a_leg_are_refused() -> None:
    (trial,) = trials_of(count=1, seconds=1.0)
    told = refusal(lambda: workflow.identify_recordings([trial], Model(ARM), zero_per_trial=["elbow"]))
    assert told.startswith("t0: zero of each trial: there is no joint 'elbow'")
    leg = nominal_model()
    time = np.arange(0, 2.0, 0.01)
    rest = np.tile([1.5, 1.0], (len(time), 1))
    record = Recording("leg", time, 1e4 * rest, rest, ("maa", "baa"), ("hip", "knee"))
    told = refusal(lambda: workflow.identify_recordings([record], leg, zero_per_trial=["hip"]))
    assert told == "leg: note 'zero.hip' is for MJCF robots alone"
