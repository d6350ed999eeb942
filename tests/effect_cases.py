"""With what numbers every effect of the package is tried: one entry an effect, which all tests of the catalogue read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

Numbers = dict[str, float]
"""Of an effect's parameters."""
Law = Callable[[float, float, float, Mapping[str, float]], tuple[float, float]]
"""(x, rate, z, parameters, at an actuator with what its pressure exerts and its rest length) → push, dz/dt."""


@dataclass(frozen=True)
class Case:
    """An effect's numbers.

    Attributes:
        strong: kind of place → numbers with which nobody could overlook it on the leg.
        stance: the same where a leg that stands and gives way under small pressures asks for others.
        apart: how far MuJoCo, whose fixed step does not resolve kinks, may be from the reduced engine then [rad].
        acting: numbers that a leg's motion shows.
        idle: numbers with which it does nothing; those that push name their own.
        plausible: places where it acts alike, and numbers that a diagnosis may find there.
        said: what its sentence says of these, or a part of it.
        law: of one that pushes and has no dry friction, in plain Python.
        begins_at_x: whether its z begins at x, else at 0.
        moves: label → place and numbers with which that law is integrated.
        inverted: whether the inverse of the plant is tried with it.
        mjcf: numbers with which nobody could overlook it on an MJCF robot.
    """

    strong: dict[str, Numbers] = field(default_factory=dict)
    stance: Numbers | None = None
    apart: float = 5e-5
    acting: Numbers | None = None
    idle: Numbers | None = None
    plausible: tuple[tuple[str, ...], Numbers] | None = None
    said: str = ""
    law: Law | None = None
    begins_at_x: bool = False
    moves: dict[str, tuple[str, Numbers]] = field(default_factory=dict)
    inverted: bool = True
    mjcf: Numbers | None = None


CASES: dict[str, Case] = {
    "transport_delay": Case(
        strong={"actuator": {"delay": 0.123}},
        acting={"delay": 0.1},
        idle={"delay": 0.0},
        plausible=(("baa",), {"delay": 0.042}),
        said="Every command reaches baa 42 ms (40 to 44) after it was given",
        mjcf={"delay": 0.15},
    ),
    "first_order_lag": Case(
        strong={"actuator": {"time_constant": 0.2}},
        acting={"time_constant": 0.1},
        idle={"time_constant": 0.0},
        plausible=(("maa",), {"time_constant": 0.16}),
        said="The pressure of maa follows its command with a time constant of 160 ms (152 to 168).",
        mjcf={"time_constant": 0.2},
    ),
    "asymmetric_lag": Case(
        strong={"actuator": {"fill": 0.2, "vent": 0.05}},
        acting={"fill": 0.1, "vent": 0.2},
        idle={"fill": 0.0, "vent": 0.0},
        plausible=(("baa",), {"fill": 0.08, "vent": 0.25}),
        said="rises with a time constant of 80 ms (76 to 84) and falls with one of 250 ms (238 to 262)",
    ),
    "rate_limit": Case(
        strong={"actuator": {"rate": 2e4}},
        stance={"rate": 5e3},
        acting={"rate": 3e4},
        idle={"rate": 1e7},
        plausible=(("maa",), {"rate": 6e4}),
        said="The pressure of maa changes no faster than 60 kPa/s (57 to 63)",
        inverted=False,
    ),
    "filling_flow": Case(
        strong={"actuator": {"rate": 1.2e4, "power": 1.5}},
        stance={"rate": 5e3, "power": 1.0},
        acting={"rate": 2e4, "power": 1.0},
        idle={"rate": 1e7, "power": 0.0},
        plausible=(("maa",), {"rate": 4e4, "power": 1.4}),
        said="The pressure of maa rises no faster than 40 kPa/s (38 to 42) under a command of 10 kPa",
        inverted=False,
    ),
    "dead_zone": Case(
        strong={"actuator": {"threshold": 3e3}},
        stance={"threshold": 5e3},
        acting={"threshold": 2e3},
        idle={"threshold": 0.0},
        plausible=(("maa", "baa"), {"threshold": 2.8e3}),
        said="The valves of maa and baa each lose the first 2.80 kPa (2.66 to 2.94) of every command: a dead zone.",
    ),
    "cutoff": Case(
        strong={"actuator": {"least": 6e3}},
        acting={"least": 5e3},
        idle={"least": 0.0},
        plausible=(("baa",), {"least": 3.2e3}),
        said="The valve of baa stays shut under commands below 3.20 kPa (3.04 to 3.36), and follows others in full",
        inverted=False,
    ),
    "saturation": Case(
        strong={"actuator": {"level": 6e3}},
        stance={"level": 3e3},
        acting={"level": 8e3},
        idle={"level": 5e4},
        plausible=(("baa",), {"level": 1.4e4}),
        said="The pressure of baa stops rising at 14.0 kPa (13.3 to 14.7)",
        inverted=False,
    ),
    "supply_coupling": Case(
        strong={"actuator": {"share": 0.5}},
        acting={"share": 0.3},
        idle={"share": 0.0},
        plausible=(("maa",), {"share": 0.06}),
        said="falls by 6.0 % (5.7 to 6.3) of what is asked of the others",
    ),
    "coulomb_friction": Case(
        strong={"actuator": {"friction": 2.0}, "joint": {"friction": 0.1}},
        apart=0.001,
        acting={"friction": 0.1},
        plausible=(("maa",), {"friction": 0.21}),
        said="Dry friction along maa of 0.210 N (0.199 to 0.221).",
        mjcf={"friction": 1.0},
    ),
    "stribeck_friction": Case(
        strong={"joint": {"friction": 0.04, "breakaway": 0.06, "velocity": 0.5}},
        apart=0.001,
        acting={"friction": 0.05, "breakaway": 0.1, "velocity": 0.1},
        plausible=(("knee",), {"friction": 0.01, "breakaway": 0.012, "velocity": 0.1}),
        said="Dry friction at the knee of 0.0100 N·m (0.0095 to 0.0105) in fast motion",
        inverted=False,
        mjcf={"friction": 0.5, "breakaway": 1.0, "velocity": 0.5},
    ),
    "hysteresis": Case(
        strong={"actuator": {"size": 2.0, "width": 0.01}},
        apart=0.001,
        acting={"size": 1.0, "width": 0.01},
        plausible=(("maa",), {"size": 0.4, "width": 0.005}),
        said="a hysteresis of ±0.40 N (0.38 to 0.42) that builds up over 5.0 mm (4.8 to 5.2)",
        law=lambda x, rate, z, p: (-p["size"] * z, (rate - abs(rate) * z) / p["width"]),
        moves={
            "hysteresis of maa": ("maa", {"size": 2.0, "width": 0.02}),
            "hysteresis of baa": ("baa", {"size": 1.0, "width": 0.01}),
        },
    ),
    "creep": Case(
        strong={"actuator": {"stiffness": 150.0, "time_constant": 0.2}},
        acting={"stiffness": 100.0, "time_constant": 0.5},
        plausible=(("maa", "baa"), {"stiffness": 12.0, "time_constant": 1.3}),
        said="maa and baa creep: beside the modelled spring 12.0 N/m (11.4 to 12.6) relax",
        law=lambda x, rate, z, p: (-p["stiffness"] * (x - z), (x - z) / p["time_constant"]),
        begins_at_x=True,
        moves={
            "creep of maa": ("maa", {"stiffness": 150.0, "time_constant": 0.3}),
            "creep of baa": ("baa", {"stiffness": 80.0, "time_constant": 0.05}),
        },
    ),
    "narrowing_area": Case(
        strong={"actuator": {"loss": 1.0}},
        acting={"loss": 0.5},
        plausible=(("baa",), {"loss": 0.6}),
        said="The area of baa shrinks as it lengthens: near the rest length by 0.60 (0.57 to 0.63) times the",
        law=lambda x, rate, z, p: (p["driven"] * (1 / (1 + p["loss"] * (x - p["l0"]) / p["l0"]) - 1), 0.0),
        moves={"narrowing maa": ("maa", {"loss": 1.0}), "widening baa": ("baa", {"loss": -0.7})},
    ),
    "nonlinear_stiffness": Case(
        strong={"actuator": {"cubic": 2e4, "centre": 0.2}},
        stance={"cubic": 3e3, "centre": 0.2},
        acting={"cubic": 5e3, "centre": 0.15},
        plausible=(("baa",), {"cubic": -2e4, "centre": 0.29}),
        said="The spring of baa softens away from a length of 290 mm (275 to 304)",
        law=lambda x, rate, z, p: (-p["cubic"] * (x - p["centre"]) ** 3, 0.0),
        moves={
            "stiffening": ("maa", {"cubic": 2e4, "centre": 0.17}),
            "softening": ("baa", {"cubic": -6e3, "centre": 0.2}),
        },
    ),
    "parallel_spring": Case(
        strong={"joint": {"stiffness": 2.0, "rest": 1.0}},
        acting={"stiffness": 0.5, "rest": 1.0},
        plausible=(("knee",), {"stiffness": 0.12, "rest": 0.4}),
        said="A spring of 0.120 N·m/rad (0.114 to 0.126) beside the knee",
        law=lambda x, rate, z, p: (-p["stiffness"] * (x - p["rest"]), 0.0),
        moves={
            "spring at the hip": ("hip", {"stiffness": 2.0, "rest": 1.1}),
            "spring at the knee": ("knee", {"stiffness": 0.7, "rest": 0.2}),
        },
        mjcf={"stiffness": 4.0, "rest": 0.5},
    ),
    "joint_stop": Case(
        strong={"joint": {"angle": 0.65, "stiffness": 20.0, "damping": 0.05}},
        stance={"angle": 1.1, "stiffness": 20.0, "damping": 0.05},
        apart=2e-4,
        acting={"angle": 0.7, "stiffness": 20.0, "damping": 0.1},
        idle={"angle": -0.035, "stiffness": 200.0, "damping": 1.0},
        plausible=(("knee",), {"angle": 0.2, "stiffness": 8.0, "damping": 0.1}),
        said="The lower stop of the knee begins at 11.5° (10.9 to 12.0), not at −2.01°",
        inverted=False,
    ),
    "payload_mass": Case(
        strong={"foot": {"mass": 0.15}, "link": {"mass": 0.3}},
        acting={"mass": 0.1},
        idle={"mass": 0.0},
        plausible=(("foot",), {"mass": 0.08}),
        said="At the foot sits a mass of 80 g (76 to 84)",
        mjcf={"mass": 0.6},
    ),
    "payload_off_centre": Case(
        mjcf={"mass": 0.6, "x": 0.1, "y": 0.0, "z": -0.2},
    ),
    "spring_tether": Case(
        mjcf={"stiffness": 20.0, "x": 0.4, "y": 0.2, "z": -0.3},
    ),
    "tether_with_free_length": Case(
        mjcf={"stiffness": 20.0, "x": 0.4, "y": 0.2, "z": -0.3, "length": 0.25},
    ),
    "plane_contact": Case(
        mjcf={"height": -0.58},
    ),
    "gravity_tilt": Case(
        strong={"base": {"angle": 0.2}},
        acting={"angle": 0.1},
        idle={"angle": 0.0},
        plausible=(("base",), {"angle": 0.09}),
        said="gravity leans by 5.2° (4.9 to 5.4)",
        mjcf={"angle": 0.3},
    ),
    "sensor_offset": Case(
        strong={"joint": {"offset": 0.1}},
        acting={"offset": 0.05},
        idle={"offset": 0.0},
        plausible=(("hip",), {"offset": -0.05}),
        said="The measured angle of the hip is 2.86° (2.72 to 3.01) too little",
        mjcf={"offset": 0.1},
    ),
    "sensor_scale": Case(
        strong={"joint": {"scale": 1.3}},
        acting={"scale": 1.1},
        idle={"scale": 1.0},
        plausible=(("knee",), {"scale": 0.96}),
        said="The measured angle of the knee is 4 % (−1 to 9) too little",
        mjcf={"scale": 1.2},
    ),
    "sensor_delay": Case(
        strong={"joint": {"delay": 0.11}},
        acting={"delay": 0.05},
        idle={"delay": 0.0},
        plausible=(("hip",), {"delay": 0.031}),
        said="The measured angle of the hip is 31.0 ms (29.4 to 32.6) older than its time stamp",
        mjcf={"delay": 0.1},
    ),
    "backlash": Case(
        strong={"joint": {"play": 0.08}},
        acting={"play": 0.05},
        idle={"play": 0.0},
        plausible=(("hip", "knee"), {"play": 0.011}),
        said="Between the hip and the knee and their sensors there is a play of 0.63° (0.60 to 0.66).",
        mjcf={"play": 0.2},
    ),
    "actuator_gain": Case(
        mjcf={"factor": 0.6},
    ),
    "asymmetric_damping": Case(
        mjcf={"difference": 0.5},
    ),
    "asymmetric_friction": Case(
        mjcf={"forward": 1.5, "backward": 0.5},
    ),
    "constant_force": Case(
        mjcf={"size": 1.5},
    ),
    "coupled_damping": Case(
        mjcf={"damping": 0.6},
    ),
    "coupled_damping_difference": Case(
        mjcf={"damping": 0.6},
    ),
    "coupled_friction": Case(
        mjcf={"friction": 1.0},
    ),
    "coupled_friction_difference": Case(
        mjcf={"friction": 1.0},
    ),
    "dahl_friction": Case(
        mjcf={"friction": 1.0, "distance": 0.1},
    ),
    "directional_load_friction": Case(
        mjcf={"drive": 0.1, "backdrive": 0.4},
    ),
    "drive_play": Case(
        mjcf={"play": 0.3},
    ),
    "friction_drift": Case(
        mjcf={"slope": 0.5},
    ),
    "friction_warmup": Case(
        mjcf={"size": 1.5, "time_constant": 1.0},
    ),
    "joint_compliance": Case(
        mjcf={"stiffness": 15.0, "damping": 0.1},
    ),
    "load_friction": Case(
        mjcf={"share": 0.3},
    ),
    "position_dependent_friction": Case(
        mjcf={"friction": 0.2, "more": 1.5, "angle": 0.5},
    ),
    "rotor_inertia": Case(
        mjcf={"inertia": 0.1},
    ),
    "motor_dead_zone": Case(
        mjcf={"threshold": 1.5},
    ),
    "supply_sag": Case(
        mjcf={"drop": 0.05},
    ),
    "quadratic_damping": Case(
        mjcf={"drag": 0.5},
    ),
    "torque_ripple": Case(
        mjcf={"sine": 1.0, "cosine": -0.7, "period": 0.3},
    ),
    "torque_saturation": Case(
        mjcf={"level": 1.5},
    ),
    "viscous_friction": Case(
        mjcf={"damping": 0.6},
    ),
}
"""Name of an effect → its numbers."""

PLAUSIBLE = {name: case.plausible for name, case in CASES.items() if case.plausible is not None}
