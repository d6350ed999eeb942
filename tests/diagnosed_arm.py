"""A diagnosis made by hand of an arm of six joints with long names, all of which rub."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pendulum_runs import recorded

from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part
from equimus_ctrl.diagnosis.localization import excess_variances, localise
from equimus_ctrl.diagnosis.residuals import Residuals
from equimus_ctrl.diagnosis.results import STATES, Diagnosis, Estimate, Evidence, Finding, Named, Ranked
from equimus_ctrl.effects import CoulombFriction, ParallelSpring
from equimus_ctrl.engines.choice import MujocoEngine
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.residuals import residuals_of
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

JOINTS = (
    "shoulder_pan_joint", "shoulder_lift_joint", "elbow_flexion_joint", "wrist_first_joint", "wrist_second_joint",
    "wrist_third_joint",
)  # fmt: skip
FRICTION = dict(zip(JOINTS, (0.5, 0.4, 0.3, 0.2, 0.1, 0.05), strict=True))
AXES = ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1", "0 1 0")


def six_joints() -> MjcfRobot:
    opened = "".join(
        f'<body name="link_{k}" pos="0 0 {0.2 * (k > 0)}"><joint name="{joint}" axis="{axis}" armature="0.1" damping="1"/>'
        f'<inertial pos="0.02 0 0.1" mass="{1 - 0.12 * k:g}" diaginertia="0.01 0.01 0.005"/>'
        for k, (joint, axis) in enumerate(zip(JOINTS, AXES, strict=True))
    )
    motors = "".join(f'<motor name="motor_of_{joint}" joint="{joint}"/>' for joint in JOINTS)
    return MjcfRobot(
        "six joints",
        '<mujoco><option timestep="0.005" gravity="0 0 0" integrator="implicitfast"/><worldbody>'
        f"{opened}{'</body>' * 6}</worldbody><actuator>{motors}</actuator></mujoco>",
    )


def diagnosed_arm(spring: bool = False) -> Diagnosis:
    """Dry friction with its own size in every joint; with a spring at the elbow besides, if that is asked for."""
    robot = six_joints()
    nominal = Model(robot)
    values = {f"{joint}.friction": size for joint, size in FRICTION.items()}
    law = Part(Candidate(CoulombFriction, JOINTS, (values,), each=True), values)
    beside = {"stiffness": 2.0, "rest": 0.3}
    other = Part(Candidate(ParallelSpring, (JOINTS[2],), (beside,)), beside)
    hypothesis = (law, other) if spring else (law,)
    real = replace(nominal, effects=tuple(effect for part in hypothesis for effect in part.effects))
    recordings = recorded(real, count=3, seconds=1.0, size=2.0, dt=0.005)
    segments = cut(nominal, recordings, shoot=0.5)
    train, heldout = (tuple(s for s in segments if (s.recording == 2) is held) for held in (False, True))
    simulator = Simulator(MujocoEngine(robot), threads=1)
    data = Data(free_parameters(nominal, ["link_0.inertia"]), list(train), simulator)
    weights, starts = white_noise([np.full((9, 6), 5e-4)]), [s.start for s in train]
    base = data.coarse_fit((), [(data.free.start, starts)], weights, 1)
    begin = np.concatenate([data.free.start, *(list(part.values.values()) for part in hypothesis)])
    best = data.coarse_fit(hypothesis, [(begin, starts)], weights, 1)
    models = dict(zip(STATES, (nominal, base.fit.model, best.fit.model), strict=True))
    residuals = {
        state: Residuals(*(tuple(residuals_of(model, part, simulator)) for part in (train, heldout)))
        for state, model in models.items()
    }
    evidence = Evidence(5e4, 74.0, -1.2e4, 5e6, 0.97, 0.95, 0.61, 0.58)
    found = [
        Finding(
            law.narrowed((joint,)),
            {"friction": Estimate(size, 0.97 * size, 1.03 * size, "N·m")},
            evidence,
            law=law,
        )
        for joint, size in FRICTION.items()
    ]
    if spring:
        estimates = {
            "stiffness": Estimate(2.0, 1.9, 2.1, "N·m/rad"),
            "rest": Estimate(0.3, 0.29, 0.31, "rad"),
        }
        found.append(Finding(other, estimates, replace(evidence, gain=900.0, share=0.12)))
    whole = Named("coulomb_friction", JOINTS, each=True)
    names = [whole, replace(whole, each=False), *(Named("asymmetric_friction", (joint,)) for joint in JOINTS)]
    sigma = np.array([own.sigma for own in best.noise])
    return Diagnosis(
        verdict="explained",
        model=nominal,
        refitted=base.fit.model,
        corrected=best.fit.model,
        base=base,
        best=best,
        train=train,
        validation=heldout,
        test=(),
        residuals=residuals,
        sigma=sigma,
        where=localise(nominal, train, residuals["refitted"].train, sigma),
        findings=tuple(found),
        unexplained=(),
        rejected=(),
        ranking=tuple(Ranked(named, 900.0 / k, 5e4 / k, 74.0) for k, named in enumerate(names, 1)),
        detectable=(),
        excess_variance={s: float(excess_variances(r.train, sigma).mean()) for s, r in residuals.items()},
        notes=(),
        seconds=60.0,
    )
