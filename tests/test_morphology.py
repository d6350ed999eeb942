"""The description of a robot: what it refuses and in which words, and its numbers by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import FrozenInstanceError, fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from morphologies import STRUCTURES, random_morphology

from equimus_ctrl.errors import ModelError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.robots.elastic.form import N_ACTUATOR, N_GLOBAL, N_JOINT
from equimus_ctrl.robots.elastic.leg import ideal_leg, nominal_leg
from equimus_ctrl.robots.elastic.morphology import (
    ElasticActuator,
    Joint,
    JointStop,
    Link,
    Morphology,
    Point,
    pack,
    structure,
)

LEG = nominal_leg()
THIGH, CALF = LEG.links
HIP, KNEE = LEG.joints
MAA, BAA = LEG.actuators


def leg(**changes: object) -> Morphology:
    return replace(LEG, **changes)


BAD_NUMBERS: list[tuple[Callable[[], object], str]] = [
    (lambda: Link("shin", 0.0, 1, 0.1, 0), "link 'shin': length is 0, expected more than 0"),
    (lambda: Link("shin", -0.25, 1, 0.1, 0), "link 'shin': length is -0.25, expected more than 0"),
    (lambda: Link("shin", math.nan, 1, 0.1, 0), "link 'shin': length is nan, expected a finite number"),
    (lambda: Link("shin", math.inf, 1, 0.1, 0), "link 'shin': length is inf, expected a finite number"),
    (lambda: Link("shin", 0.2, 0, 0.1, 0), "link 'shin': mass is 0, expected more than 0"),
    (lambda: Link("shin", 0.2, 1, math.nan, 0), "link 'shin': com is nan, expected a finite number"),
    (lambda: Link("shin", 0.2, 1, 0.1, -1e-3), "link 'shin': inertia is -0.001, expected at least 0"),
    (lambda: Point("thigh", -0.1), "point on thigh: radius is -0.1, expected at least 0"),
    (lambda: Point("thigh", math.inf), "point on thigh: radius is inf, expected a finite number"),
    (lambda: Point("thigh", 0.1, math.nan), "point on thigh: angle is nan, expected a finite number"),
    (lambda: JointStop(math.inf), "joint stop: angle is inf, expected a finite number"),
    (lambda: JointStop(0.0, -1.0), "joint stop: stiffness is -1, expected at least 0"),
    (lambda: JointStop(0.0, 1.0, math.nan), "joint stop: damping is nan, expected a finite number"),
    (lambda: Joint("hip", "base", "thigh", -0.1), "joint 'hip': damping is -0.1, expected at least 0"),
    (lambda: replace(MAA, mass=-0.1), "actuator 'maa': mass is -0.1, expected at least 0"),
    (lambda: replace(MAA, stiffness=-1), "actuator 'maa': stiffness is -1, expected at least 0"),
    (lambda: replace(MAA, damping=-1), "actuator 'maa': damping is -1, expected at least 0"),
    (lambda: replace(MAA, rest_length=0), "actuator 'maa': rest_length is 0, expected more than 0"),
    (lambda: replace(MAA, area=0), "actuator 'maa': area is 0, expected more than 0"),
    (lambda: replace(MAA, area=math.nan), "actuator 'maa': area is nan, expected a finite number"),
    (lambda: leg(base_mass=-1), "nominal_leg: base_mass is -1, expected at least 0"),
    (lambda: leg(gravity=math.nan), "nominal_leg: gravity is nan, expected a finite number"),
    (lambda: leg(tilt=math.inf), "nominal_leg: tilt is inf, expected a finite number"),
    (
        lambda: leg(command_low=60e3),
        "nominal_leg: the lowest command 60000 Pa is not below the highest, 50000 Pa",
    ),
    (
        lambda: Joint("knee", "thigh", "calf", 0.0, JointStop(2.0), JointStop(-0.035)),
        "joint 'knee': the lower stop at 2 rad is not below the upper one at -0.035 rad",
    ),
]


@pytest.mark.parametrize(("make", "message"), BAD_NUMBERS, ids=[message for _, message in BAD_NUMBERS])
def test_a_number_that_cannot_be_is_named_with_its_owner_and_what_would_be_right(
    make: Callable[[], object], message: str
) -> None:
    with pytest.raises(ModelError) as caught:
        make()
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("command_low", math.inf),
        ("command_low", math.nan),
        ("command_high", -math.inf),
        ("command_high", math.nan),
        ("command_low", -math.inf),
        ("command_high", math.inf),
    ],
)
def test_a_command_range_must_be_finite(key: str, value: float) -> None:
    with pytest.raises(ModelError, match="command"):
        leg(**{key: value})


BAD_TREES: list[tuple[Callable[[], object], tuple[str, ...]]] = [
    (lambda: leg(links=()), ("nominal_leg", "at least one link")),
    (lambda: leg(actuators=()), ("nominal_leg", "at least one actuator")),
    (lambda: leg(actuators=(MAA, replace(BAA, name="maa"))), ("the name 'maa' is used twice",)),
    (lambda: leg(joints=(replace(HIP, name="thigh"), KNEE)), ("the name 'thigh' is used twice",)),
    (lambda: leg(actuators=(MAA, replace(BAA, name="b a"))), ("'b a' is not a plain name", "letters, digits and '_'")),
    (lambda: leg(foot="claf"), ("foot: there is no link 'claf'; did you mean 'calf'?", "(known: calf, thigh)")),
    (lambda: leg(joints=(HIP,)), ("link 'calf' hangs on no joint",)),
    (
        lambda: leg(joints=(HIP, replace(KNEE, child="calve"))),
        ("joint 'knee': there is no link 'calve'; did you mean 'calf'?", "(known: calf, thigh)"),
    ),
    (
        lambda: leg(joints=(HIP, replace(KNEE, parent="tigh"))),
        ("joint 'knee': there is no link 'tigh'; did you mean 'thigh'?",),
    ),
    (lambda: leg(joints=(HIP, replace(KNEE, child="base"))), ("joint 'knee': there is no link 'base'",)),
    (lambda: leg(joints=(KNEE, HIP)), ("joint 'knee' hangs on 'thigh' before any joint carries", "parents first")),
    (
        lambda: leg(joints=(HIP, KNEE, Joint("loop", "base", "calf"))),
        ("link 'calf' is carried by both joint 'knee' and joint 'loop'", "closed skeleton loop is not supported"),
    ),
    (
        lambda: leg(joints=(HIP, KNEE, Joint("loop", "calf", "thigh"))),
        ("link 'thigh' is carried by both joint 'hip' and joint 'loop'",),
    ),
    (
        lambda: leg(joints=(replace(HIP, parent="calf"), KNEE)),
        ("joint 'hip' hangs on 'calf' before any joint carries", "closed skeleton loop"),
    ),
    (
        lambda: leg(joints=(replace(HIP, at=Point("calf", 0.1)), KNEE)),
        ("joint 'hip': sits on 'calf' but its parent is 'base'",),
    ),
    (
        lambda: leg(actuators=(replace(MAA, insertion=Point("thihg", 0.1)), BAA)),
        ("actuator 'maa': there is no body 'thihg'; did you mean 'thigh'?", "(known: base, calf, thigh)"),
    ),
    (
        lambda: leg(actuators=(replace(MAA, origin=Point("thigh", 0.1)), BAA)),
        ("actuator 'maa' has both ends on 'thigh'", "must be on two different bodies"),
    ),
]


@pytest.mark.parametrize(("make", "parts"), BAD_TREES, ids=[parts[0] for _, parts in BAD_TREES])
def test_a_tree_that_cannot_be_is_refused_in_one_sentence(make: Callable[[], object], parts: tuple[str, ...]) -> None:
    with pytest.raises(ModelError) as caught:
        make()
    for part in parts:
        assert part in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("taken", ["base", "world"])
def test_a_name_taken_by_the_ground_is_refused_as_such(taken: str) -> None:
    """MuJoCo calls its own root body "world"; a link of that name could not be built later."""
    link, joint = Link.rod(taken, 0.2, 0.1), Joint("pivot", "base", taken)
    drive = replace(MAA, insertion=Point(taken, 0.1))
    with pytest.raises(ModelError, match=rf"one: the name '{taken}' is taken; it means the ground"):
        Morphology("one", (link,), (joint,), (drive,), foot=taken)


@pytest.mark.parametrize(
    ("origin", "insertion"),
    [
        (Point("base", 0.06), Point("thigh", 0.0)),
        (Point("base", 0.0), Point("thigh", 0.2)),
        (Point("thigh", 0.25), Point("calf", 0.1)),
        (Point("base", 0.0), Point("thigh", 0.0)),
    ],
)
def test_an_actuator_that_no_joint_can_lengthen_is_refused(origin: Point, insertion: Point) -> None:
    """An end on the axis of the only joint between the two bodies: the length is the same at every pose."""
    with pytest.raises(ModelError, match="actuator 'maa' has an end on the only joint between its two bodies"):
        leg(actuators=(replace(MAA, origin=origin, insertion=insertion), BAA))
    with pytest.raises(ModelError, match="its length never changes"):
        leg(actuators=(replace(MAA, origin=insertion, insertion=origin), BAA))


def test_an_end_on_a_joint_is_welcome_where_another_joint_moves_it() -> None:
    """On the hip's axis with the other end on the calf the knee lengthens it; on the knee's axis the hip does."""
    for origin, insertion in [
        (Point("base", 0.0), Point("calf", 0.1)),
        (Point("base", 0.1), Point("calf", 0.0)),
        (Point("base", 0.06), Point("thigh", 0.25)),
        # As far along the calf as the knee is along the thigh: its tip, no pivot.
        (Point("thigh", 0.1), Point("calf", 0.25)),
    ]:
        m = leg(actuators=(replace(MAA, origin=origin, insertion=insertion), BAA))
        assert np.abs(Kinematics(m).jacobian([1.3, 0.7])[0]).max() > 0.01


@pytest.mark.parametrize("name", STRUCTURES)
def test_robots_whose_lengths_do_change_are_not_refused(name: str) -> None:
    for seed in range(10):
        m = random_morphology(name, seed)
        assert np.all(np.abs(Kinematics(m).jacobian(np.full(len(m.joints), 0.4))).max(axis=1) > 0)


@pytest.mark.parametrize("make", [nominal_leg, ideal_leg])
def test_the_legs_are_those_of_the_published_tables(make: Callable[[], Morphology]) -> None:
    m = make()
    assert m.joint_names == ("hip", "knee")
    assert m.actuator_names == ("maa", "baa")
    assert m.gravity == 9.8
    assert [link.length for link in m.links] == [0.25, 0.25]
    assert [link.mass for link in m.links] == [0.086, 0.1033]
    assert [a.mass for a in m.actuators] == [0.1865, 0.2727]
    np.testing.assert_allclose(m.actuators[0].origin.xy, (0.06, 0), atol=1e-15)
    np.testing.assert_allclose(m.actuators[1].origin.xy, (-0.10, 0), atol=1e-15)
    turn = math.radians(-8.13)
    np.testing.assert_allclose(m.actuators[0].insertion.xy, (0.21213 * math.cos(turn), 0.21213 * math.sin(turn)))
    np.testing.assert_allclose(m.actuators[1].insertion.xy, (0.1 * math.cos(math.pi / 6), 0.05))
    np.testing.assert_allclose(m.joint_range, [[math.pi / 6, -0.035], [5 * math.pi / 6, 2.0]])
    for joint in m.joints:
        for stop in (joint.lower, joint.upper):
            assert stop is not None
            assert (stop.stiffness, stop.damping) == (200.0, 1.0)


def test_the_nominal_and_the_ideal_leg_differ_in_inertia_and_identified_numbers() -> None:
    nominal, ideal = nominal_leg().parameters(), ideal_leg().parameters()
    expected = {
        "thigh.com": (0.1267, 0.125),
        "thigh.inertia": (5.46e-4, 4.73e-4),
        "calf.com": (0.139, 0.125),
        "calf.inertia": (6.52e-4, 5.68e-4),
        "hip.damping": (0.524, 0.0),
        "knee.damping": (0.062, 0.0),
        "maa.stiffness": (265.82, 367.8),
        "baa.stiffness": (110.36, 291.8),
        "maa.damping": (12.48, 10.8),
        "baa.damping": (24.79, 11.3),
        "maa.rest_length": (0.1803, 0.1744),
        "baa.rest_length": (0.2565, 0.2536),
        "maa.area": (0.000403, 6.54e-4),
        "baa.area": (0.000436, 6.37e-4),
    }
    assert {key: (nominal[key], ideal[key]) for key in nominal if nominal[key] != ideal[key]} == expected


def test_a_rod_has_the_moment_of_a_thin_uniform_rod() -> None:
    rod = Link.rod("rod", 0.3, 0.6)
    x, w = np.polynomial.legendre.leggauss(8)
    along = 0.15 * (x + 1)
    density = 0.6 / 0.3 * 0.15 * w
    assert rod.mass == pytest.approx(density.sum())
    assert rod.com == pytest.approx((density * along).sum() / density.sum())
    assert rod.inertia == pytest.approx((density * (along - rod.com) ** 2).sum())


@given(x=st.floats(-2, 2), y=st.floats(-2, 2))
def test_cartesian_coordinates_come_back(x: float, y: float) -> None:
    np.testing.assert_allclose(Point.cartesian("base", x, y).xy, (x, y), rtol=1e-14, atol=1e-15)


def test_names_stops_chains_and_pivots() -> None:
    assert [joint.name for joint in LEG.chain("calf")] == ["hip", "knee"]
    assert LEG.chain("base") == ()
    assert LEG.link("calf") is CALF
    assert LEG.joint_point(HIP) == Point("base", 0.0)
    assert LEG.joint_point(KNEE) == Point("thigh", 0.25)
    own = Point("thigh", 0.2, 0.1)
    assert LEG.joint_point(replace(KNEE, at=own)) is own
    free = leg(joints=(replace(HIP, lower=None, upper=None), KNEE))
    low, high = free.joint_range
    assert (low[0], high[0]) == (-math.inf, math.inf)
    assert not low.flags.writeable
    assert not high.flags.writeable


def test_a_morphology_cannot_be_changed() -> None:
    with pytest.raises(FrozenInstanceError):
        LEG.gravity = 1.0  # type: ignore[misc]
    assert hash(nominal_leg()) == hash(LEG)


def count_numbers(part: object) -> int:
    """How many numbers a nest of dataclasses holds, names of poses and options aside."""
    if isinstance(part, bool | str | dict) or part is None:
        return 0
    if isinstance(part, int | float):
        return 1
    if isinstance(part, tuple):
        return sum(count_numbers(item) for item in part)
    return sum(count_numbers(getattr(part, f.name)) for f in fields(part))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", STRUCTURES)
def test_parameters_name_every_number_once(name: str) -> None:
    m = random_morphology(name, 3, stops=True)
    assert len(m.parameters()) == count_numbers(m)
    assert m.parameters()["drive0.origin.radius"] == m.actuators[0].origin.radius
    assert m.parameters()["joint0.lower.stiffness"] == m.joints[0].lower.stiffness  # type: ignore[union-attr]


@settings(deadline=None, max_examples=60, derandomize=True)
@given(data=st.data())
def test_what_is_put_in_by_name_is_read_back_and_nothing_else_changes(data: st.DataObject) -> None:
    m = random_morphology(data.draw(st.sampled_from(sorted(STRUCTURES))), data.draw(st.integers(0, 20)), stops=True)
    before = m.parameters()
    names = data.draw(st.lists(st.sampled_from(sorted(before)), unique=True, max_size=6))
    values = {name: before[name] * data.draw(st.floats(0.5, 1.5)) for name in names}
    changed = m.with_parameters(values)
    assert changed.parameters() == before | values
    assert m.parameters() == before
    assert changed.with_parameters({name: before[name] for name in names}) == m
    assert structure(changed) == structure(m)


def test_numbers_of_any_kind_are_parameters() -> None:
    """A length from a numpy table of single precision, or a whole number, is a number like any other."""
    plain = leg(links=(Link("thigh", 1, 2, 0.5, 1e-3), CALF))
    assert plain.parameters()["thigh.length"] == 1.0
    single = leg(links=(Link("thigh", np.float32(0.25), 0.086, 0.1267, 5.46e-4), CALF))  # type: ignore[arg-type]
    assert single.with_parameters({"thigh.length": 0.3}).links[0].length == 0.3


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("maa.stifness", ("no parameter 'maa.stifness'; did you mean 'maa.stiffness'?", "maa.rest_length")),
        ("hip.lower.angel", ("did you mean 'hip.lower.angle'?", "hip.upper.stiffness")),
        ("stiffness", ("no parameter 'stiffness'", "maa.stiffness", "gravity")),
        ("name", ("no parameter 'name'",)),
    ],
)
def test_an_unknown_parameter_names_the_nearest_and_those_of_its_owner(name: str, parts: tuple[str, ...]) -> None:
    with pytest.raises(ModelError) as caught:
        LEG.with_parameters({name: 1.0})
    for part in ("nominal_leg", *parts):
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"maa.stiffness": -1.0}, "actuator 'maa': stiffness is -1, expected at least 0"),
        ({"calf.length": math.nan}, "link 'calf': length is nan, expected a finite number"),
        ({"hip.lower.angle": 3.0}, "joint 'hip': the lower stop at 3 rad is not below the upper one at 2.61799 rad"),
        ({"command_high": -1.0}, "nominal_leg: the lowest command 0 Pa is not below the highest, -1 Pa"),
    ],
)
def test_a_parameter_that_cannot_be_is_refused(values: dict[str, float], message: str) -> None:
    with pytest.raises(ModelError) as caught:
        LEG.with_parameters(values)
    assert str(caught.value) == message


def test_two_stops_may_move_past_where_the_other_was() -> None:
    moved = LEG.with_parameters({"hip.lower.angle": 3.0, "hip.upper.angle": 4.0})
    np.testing.assert_allclose([side[0] for side in moved.joint_range], (3.0, 4.0))


@pytest.mark.parametrize("name", STRUCTURES)
def test_the_packed_vector_has_the_documented_length_and_order(name: str) -> None:
    m = random_morphology(name, 1, stops=True)
    vector = pack(m)
    assert len(vector) == N_GLOBAL + N_JOINT * len(m.joints) + N_ACTUATOR * len(m.actuators)
    assert list(vector[:3]) == [m.gravity, m.tilt, m.base_mass]
    assert list(vector[-5:]) == [
        m.actuators[-1].mass,
        m.actuators[-1].stiffness,
        m.actuators[-1].damping,
        m.actuators[-1].rest_length,
        m.actuators[-1].area,
    ]
    assert structure(m) == (*STRUCTURES[name], len(m.joints) - 1)


def test_an_absent_stop_lies_at_infinity_and_is_soft() -> None:
    free = leg(joints=(replace(HIP, lower=None, upper=None), KNEE))
    assert list(pack(free)[6:12]) == [-math.inf, 0.0, 0.0, math.inf, 0.0, 0.0]


def test_an_actuator_has_no_sign_of_its_own() -> None:
    """Swapping the two ends of every actuator describes the same robot."""

    def turned(a: ElasticActuator) -> ElasticActuator:
        return replace(a, origin=a.insertion, insertion=a.origin)

    swapped = leg(actuators=tuple(turned(a) for a in LEG.actuators))
    q, v, p = [1.2, 0.4], [0.3, -2.0], [1e4, 2e4]
    np.testing.assert_allclose(
        Kinematics(swapped).acceleration(q, v, p), Kinematics(LEG).acceleration(q, v, p), rtol=1e-12
    )
