"""One of everything that a file of your own can add: an effect, a controller, a plant, a scenario."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

import equimus_ctrl as eq


@eq.register
@dataclass(frozen=True)
class Ripple(eq.ForceEffect):
    """size·sin(6·x)."""

    name, summary = "ripple", "a torque that comes back six times a turn"
    robots, sits_at, neutral = ("elastic", "mjcf"), ("joint",), {"size": 0.0}
    leg_sizes = (eq.Size("size", 2e-3, 0.05, "from below the noise to 1° of hip"),)
    mjcf_sizes = (eq.Share("size", 0.05, 0.3),)
    size: float = eq.parameter("N·m", -10.0, 10.0, "amplitude")

    @classmethod
    def force(cls, x, rate, z, p):
        return p["size"] * ca.sin(6 * x)

    @classmethod
    def sentence(cls, t):
        return f"A torque of {t['size']} comes back six times a turn at {t.the}."


class Leaning:
    """The pressures that hold the reference at rest, some less; how much less can be tuned."""

    def __init__(self, share=0.95):
        self.share = share

    def init(self, spec, observation):
        return eq.Kinematics(spec.model, spec.phase)

    def step(self, observation, reference, kinematics):
        return self.share * kinematics.static_pressure(reference.position(observation.time)), kinematics


eq.register_controller(
    "leaning",
    eq.ControllerEntry(
        "static pressures, some less",
        lambda given: Leaning(**(given.settings or {})),
        settings="leaning.toml",
        needs=frozenset({"lengths"}),
        search={"share": eq.Range(0.5, 1.5, 0.95, scale="linear")},
    ),
)


def slow_leg(given):
    """The simulated leg behind a slow bus."""
    rates = eq.PlantRates(control=60.0, sensor=60.0)
    return eq.MujocoPlant(given.model, nominal=given.nominal, noise=given.noise, events=given.events, rates=rates)


eq.register_plant("slow_leg", eq.PlantEntry("the leg in MuJoCo, commands and angles at 60 Hz", slow_leg))


def nod(context, knee: float = 30.0, duration: float = 4.0):
    """The knee bends and straightens once a second."""
    context.require(("hip", "knee"), ("maa", "baa"), "nod")

    def pose(time):
        return np.radians([90.0, 10.0 + knee * np.sin(np.pi * time) ** 2])

    return eq.Scenario("nod", f"a knee that bends by {knee:g}° each second", duration, eq.FunctionReference(pose))


eq.register_scenario("nod", nod)
