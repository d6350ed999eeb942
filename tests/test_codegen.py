"""Generated source says what CasADi says, and compiled kernels say what the symbolic model says."""

from __future__ import annotations

import ctypes
import math
import operator
import uuid
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from morphologies import STRUCTURES, random_morphology, random_poses

from equimus_ctrl.engines import compiled
from equimus_ctrl.engines.lane_objects import load
from equimus_ctrl.errors import ModelError
from equimus_ctrl.models import codegen
from equimus_ctrl.models.codegen import Routine, generate
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.lane_code import LaneRoutine, generate_lanes
from equimus_ctrl.models.symbolic import symbolic_model
from equimus_ctrl.models.symbolic_model import pseudo_solve
from equimus_ctrl.robots.elastic.leg import ideal_leg, nominal_leg
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, pack
from equimus_ctrl.tuning import loop_kernel

PLAIN = "# decorated"
"""A comment in the decorator's place: the generated functions run as ordinary Python."""


def run_source(source: str) -> dict[str, Any]:
    names: dict[str, Any] = {"math": math, "np": np}
    exec(source, names)
    return names


def equal(left: ca.SX, right: ca.SX) -> ca.SX:
    return left == right


def differ(left: ca.SX, right: ca.SX) -> ca.SX:
    return left != right


OPERATIONS: dict[int, Callable[[ca.SX, ca.SX], ca.SX]] = {
    ca.OP_ADD: operator.add,
    ca.OP_SUB: operator.sub,
    ca.OP_MUL: operator.mul,
    ca.OP_DIV: operator.truediv,
    ca.OP_POW: lambda a, b: ca.fabs(a) ** b,
    ca.OP_CONSTPOW: lambda a, b: ca.constpow(ca.fabs(a), 2.7),
    ca.OP_LT: operator.lt,
    ca.OP_LE: operator.le,
    ca.OP_EQ: equal,
    ca.OP_NE: differ,
    ca.OP_AND: lambda a, b: ca.logic_and(a > 0, b > 0),
    ca.OP_OR: lambda a, b: ca.logic_or(a > 0, b > 0),
    ca.OP_NOT: lambda a, b: ca.logic_not(a > b),
    ca.OP_FMIN: ca.fmin,
    ca.OP_FMAX: ca.fmax,
    ca.OP_IF_ELSE_ZERO: lambda a, b: ca.if_else(a > b, a * b, 0),
    ca.OP_ATAN2: ca.atan2,
    ca.OP_NEG: lambda a, b: -a,
    ca.OP_INV: lambda a, b: 1 / a,
    ca.OP_SQ: lambda a, b: a**2,
    ca.OP_TWICE: lambda a, b: 2 * a,
    ca.OP_SQRT: lambda a, b: ca.sqrt(ca.fabs(a)),
    ca.OP_SIN: lambda a, b: ca.sin(a),
    ca.OP_COS: lambda a, b: ca.cos(a),
    ca.OP_TAN: lambda a, b: ca.tan(a),
    ca.OP_EXP: lambda a, b: ca.exp(a),
    ca.OP_LOG: lambda a, b: ca.log(ca.fabs(a)),
    ca.OP_TANH: lambda a, b: ca.tanh(a),
    ca.OP_FABS: lambda a, b: ca.fabs(a),
    ca.OP_SIGN: lambda a, b: ca.sign(a),
    ca.OP_ASIN: lambda a, b: ca.asin(ca.tanh(a)),
    ca.OP_ACOS: lambda a, b: ca.acos(ca.tanh(a)),
    ca.OP_ATAN: lambda a, b: ca.atan(a),
    ca.OP_SINH: lambda a, b: ca.sinh(ca.tanh(a)),
    ca.OP_COSH: lambda a, b: ca.cosh(ca.tanh(a)),
    ca.OP_LOG1P: lambda a, b: ca.log1p(ca.fabs(a)),
    ca.OP_EXPM1: lambda a, b: ca.expm1(ca.tanh(a)),
    ca.OP_HYPOT: ca.hypot,
    ca.OP_ERF: lambda a, b: ca.erf(a),
}
"""One expression that makes CasADi use each operation; OP_ASSIGN never appears in an SX function."""


@lru_cache(maxsize=128)
def both(op: int, sides: str) -> tuple[ca.Function, Callable[..., tuple[float, ...]]]:
    """CasADi's function and the generated one of an operation; ``sides`` says of what: x a variable, p a parameter."""
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 2)
    a, b = (x[i] if side == "x" else p[i] for i, side in enumerate(sides))
    # A second use of the result, so that a value handed on is a value computed once.
    value = OPERATIONS[op](a, b)
    output = ca.vertcat(value, 3 - value * x[0])
    function = ca.Function("exact", [x, p], [output])
    assert op in {function.instruction_id(k) for k in range(function.n_instructions())}
    names = run_source(generate([Routine("routine", {"x": x}, output)], p, PLAIN))
    return function, lambda x, p: names["routine"](tuple(x), names["prepare"](np.array(p)))


def test_every_operation_of_the_table_is_tried() -> None:
    assert set(OPERATIONS) == set(codegen._BINARY) - {ca.OP_ASSIGN}
    assert eval(codegen._BINARY[ca.OP_ASSIGN].format("3.5")) == 3.5


@pytest.mark.parametrize("sides", ["xx", "xp", "px", "pp"])
@pytest.mark.parametrize("op", OPERATIONS)
@settings(deadline=None, max_examples=15, derandomize=True)
@given(
    x=st.lists(st.floats(-8, 8), min_size=2, max_size=2),
    p=st.lists(st.floats(-8, 8), min_size=2, max_size=2),
    same=st.booleans(),
)
def test_an_operation_gives_what_casadi_gives(op: int, sides: str, x: list[float], p: list[float], same: bool) -> None:
    if same:  # comparisons change their answer at equality
        x[1] = x[0]
        p = list(x)
    if op in (ca.OP_DIV, ca.OP_INV, ca.OP_LOG, ca.OP_POW):
        x, p = ([value if abs(value) > 1e-3 else 0.5 for value in values] for values in (x, p))
    exact, routine = both(op, sides)
    np.testing.assert_allclose(routine(x, p), np.array(exact(x, p)).ravel(), rtol=1e-13, atol=1e-300)


def generated(output: ca.SX, inputs: dict[str, ca.SX], p: ca.SX) -> tuple[str, dict[str, Any]]:
    source = generate([Routine("routine", inputs, output)], p, PLAIN)
    return source, run_source(source)


def test_what_depends_on_parameters_alone_is_done_once_in_prepare() -> None:
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 3)
    output = ca.vertcat(ca.sin(p[0] * p[1]) * x[0] + p[2], ca.exp(p[2]), x[1])
    source, names = generated(output, {"x": x}, p)
    prepare, routine = source.split("def routine")
    assert "math.sin" in prepare
    assert "math.exp" in prepare
    assert "math." not in routine
    constants = names["prepare"](np.array([0.3, 2.0, -1.0]))
    assert constants.shape == (3,)  # sin(p0 p1), p2 and exp(p2), each once
    expected = (math.sin(0.6) * 5 - 1, math.exp(-1), 7.0)
    np.testing.assert_allclose(names["routine"]((5.0, 7.0), constants), expected, rtol=1e-15)


def test_routines_share_one_array_of_constants() -> None:
    x, p = ca.SX.sym("x"), ca.SX.sym("p", 2)
    routines = [
        Routine("first", {"x": x}, ca.cos(p[0]) * x),
        Routine("second", {"x": x}, ca.cos(p[0]) + ca.cos(p[1]) * x),
        Routine("third", {}, p),
    ]
    names = run_source(generate(routines, p, PLAIN))
    c = names["prepare"](np.array([0.4, 1.1]))
    np.testing.assert_allclose(names["first"]((2.0,), c), [2 * math.cos(0.4)])
    np.testing.assert_allclose(names["second"]((2.0,), c), [math.cos(0.4) + 2 * math.cos(1.1)])
    np.testing.assert_allclose(names["third"](c), [0.4, 1.1])


def test_outputs_come_column_by_column_with_their_zeros() -> None:
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 1)
    _, names = generated(ca.diag(x) + 0 * p, {"x": x}, p)
    assert names["routine"]((2.0, 3.0), names["prepare"](np.array([1.0]))) == (2.0, 0.0, 0.0, 3.0)
    _, names = generated(ca.SX(ca.DM([1.5, -2.0])), {"x": x}, p)
    assert names["routine"]((0.0, 0.0), names["prepare"](np.array([1.0]))) == (1.5, -2.0)


def test_negative_constants_keep_their_sign() -> None:
    x, p = ca.SX.sym("x"), ca.SX.sym("p")
    _, names = generated(ca.vertcat(ca.SX(-2.0) ** x, x - ca.SX(-3.0), 0.5 - (-x)), {"x": x}, p)
    assert names["routine"]((2.0,), names["prepare"](np.array([0.0]))) == (4.0, 5.0, 2.5)


def test_an_operation_without_source_form_is_refused() -> None:
    x, p = ca.SX.sym("x"), ca.SX.sym("p")
    with pytest.raises(ModelError, match=rf"routine: CasADi operation {ca.OP_FLOOR} has no source form"):
        generate([Routine("routine", {"x": x}, ca.floor(x))], p, PLAIN)


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_a_constant_that_is_no_number_is_refused(value: float) -> None:
    x, p = ca.SX.sym("x"), ca.SX.sym("p")
    with pytest.raises(ValueError, match=f"the constant {value}"):
        generate([Routine("routine", {"x": x}, ca.vertcat(x, value))], p, PLAIN)


# --- lanes ------------------------------------------------------------------------------------------------------

WIDTH = 3


def run_lanes(routines: list[LaneRoutine], p: ca.SX, first: int, folder: Path) -> tuple[dict[str, Any], int]:
    """The functions as an engine loads them, and how many rows they need."""
    prefix = f"test_{uuid.uuid4().hex}"
    made = generate_lanes(routines, p, WIDTH, prefix, first)
    (folder / "lanes.o").write_bytes(made.code)
    addresses = load(folder / "lanes.o", prefix, ("prepare", *made.names))
    pointer = ctypes.POINTER(ctypes.c_double)

    def function(name: str, *kinds: Any) -> Any:
        return ctypes.CFUNCTYPE(None, *kinds)(addresses[name])

    def at(values: Any) -> Any:
        return values.ctypes.data_as(pointer)

    prepare = function("prepare", pointer, pointer, ctypes.c_int64)
    names: dict[str, Any] = {"prepare_lane": lambda numbers, w, lane: prepare(at(numbers), at(w), lane)}
    for name in made.names:
        own = function(name, pointer)
        names[name] = lambda w, own=own: own(at(w))
    return names, made.rows


@pytest.mark.parametrize("sides", ["xx", "xp", "pp"])
@pytest.mark.parametrize("op", OPERATIONS)
def test_an_operation_gives_what_casadi_gives_in_every_lane(op: int, sides: str, tmp_path: Path) -> None:
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 2)
    a, b = (x[i] if side == "x" else p[i] for i, side in enumerate(sides))
    value = OPERATIONS[op](a, b)
    output = ca.vertcat(value, 3 - value * x[0])
    routine = LaneRoutine("routine", {"x": x}, output, {"x": 1}, 4)
    names, rows = run_lanes([routine], p, 6, tmp_path)
    exact = ca.Function("exact", [x, p], [output])
    for numbers in ([[1.3, -0.7, 2.0], [-2.1, 0.4, 2.0]], [[0.5, 3.0, -1.0], [0.5, -3.0, 4.0]]):
        parameters = np.array([[0.3, -1.2], [2.0, 0.7], [-0.4, -0.4]])
        w = np.full(rows * WIDTH, 9.0)
        w.reshape(rows, WIDTH)[1:3] = numbers
        for lane in range(WIDTH):
            names["prepare_lane"](parameters[lane], w, lane)
        names["routine"](w)
        for lane in range(WIDTH):
            expected = np.array(exact(np.array(numbers)[:, lane], parameters[lane])).ravel()
            np.testing.assert_allclose(w.reshape(rows, WIDTH)[4:6, lane], expected, rtol=1e-13, atol=1e-15)
        np.testing.assert_array_equal(w.reshape(rows, WIDTH)[[0, 3]], 9.0)  # nobody's rows
        np.testing.assert_array_equal(w.reshape(rows, WIDTH)[1:3], numbers)


def test_lane_routines_share_rows_of_constants_made_once(tmp_path: Path) -> None:
    x, p = ca.SX.sym("x"), ca.SX.sym("p", 2)
    routines = [
        LaneRoutine("first", {"x": x}, ca.cos(p[0]) * ca.sin(x), {"x": 0}, 1),
        LaneRoutine("second", {"x": x}, ca.vertcat(ca.exp(p[1]) + x, p[0]), {"x": 1}, 2),
        LaneRoutine("nothing", {"x": x}, ca.SX(0, 1), {"x": 0}, 3),
    ]
    names, rows = run_lanes(routines, p, 4, tmp_path)
    assert rows == 4 + 3  # cos(p0), exp(p1) and p0
    w = np.zeros(rows * WIDTH)
    w[:WIDTH] = [0.1, 0.2, 0.3]
    for lane in range(WIDTH):
        names["prepare_lane"](np.array([lane, 0.5]), w, lane)
    for name in ("first", "second", "nothing"):
        names[name](w)
    found = w.reshape(rows, WIDTH)
    np.testing.assert_allclose(found[1], np.cos([0, 1, 2]) * np.sin([0.1, 0.2, 0.3]), rtol=1e-15)
    np.testing.assert_allclose(found[2], math.exp(0.5) + found[1], rtol=1e-15)
    np.testing.assert_array_equal(found[3], [0, 1, 2])


@pytest.fixture(scope="module")
def waves(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Sines and cosines (n,) of x (n,)."""
    x, p = ca.SX.sym("x"), ca.SX.sym("p")
    routine = LaneRoutine("waves", {"x": x}, ca.vertcat(ca.sin(x), ca.cos(x)), {"x": 0}, 1)
    names, rows = run_lanes([routine], p, 3, tmp_path_factory.mktemp("waves"))

    def both(values: Any) -> Any:
        w, found = np.zeros((rows, WIDTH)), []
        for value in np.atleast_1d(values):
            w[0] = value
            names["waves"](w)
            found.append(w[1:3, 0].copy())
        return np.array(found).T

    return both


@settings(deadline=None, max_examples=500, derandomize=True)
@given(x=st.floats(-1e5, 1e5))
def test_sines_and_cosines_are_right_to_rounding(waves: Any, x: float) -> None:
    np.testing.assert_allclose(waves(x)[:, 0], [math.sin(x), math.cos(x)], rtol=0, atol=4e-16)


def test_they_are_right_around_every_quadrant(waves: Any) -> None:
    x = np.concatenate(
        [k * math.pi / 4 + np.array([-1e-3, -1e-9, -1e-18, 0, 1e-18, 1e-9, 1e-3]) for k in range(-24, 25)]
    )
    np.testing.assert_allclose(waves(x), [np.sin(x), np.cos(x)], rtol=0, atol=4e-16)
    np.testing.assert_array_equal(waves(0.0)[:, 0], [0.0, 1.0])
    assert np.isnan(waves(math.nan)).all() and np.isnan(waves(math.inf)).all()


def model_routines(m: Morphology, phase: Phase) -> tuple[dict[str, Any], ca.Function]:
    """The generated functions of a structure, and CasADi's own."""
    s = symbolic_model(m, phase)
    drive = s.jacobian.T @ ca.diag(s.area)
    outputs = [s.lengths, s.area, s.static_pressure, pseudo_solve(drive, s.tau), drive @ s.f]
    names = vars(compiled._model(compiled.structure(m), phase))
    return names, ca.Function("exact", [s.q, s.f, s.tau, s.p], outputs)


@pytest.mark.parametrize("phase", ["swing", "stance"])
@pytest.mark.parametrize("name", STRUCTURES)
def test_the_generated_functions_are_the_symbolic_ones(name: str, phase: Phase) -> None:
    """Run as ordinary Python, which needs no compilation."""
    m = random_morphology(name, 2, stops=True)
    names, exact = model_routines(m, phase)
    nj, na = len(m.joints), len(m.actuators)
    assert (names["N_JOINTS"], names["N_ACTUATORS"]) == (nj, na)
    rng = np.random.default_rng(0)
    c = names["prepare"].py_func(pack(m))
    for pose in random_poses(m, rng, 3):
        q, f, tau = (tuple(x) for x in (pose, rng.normal(0, 9, na), rng.normal(0, 1, nj)))
        expected = [np.array(x).ravel() for x in exact(q, f, tau, pack(m))]
        found = [
            names["actuator_lengths"].py_func(q, c),
            names["actuator_areas"].py_func(c),
            names["static_pressure"].py_func(q, c),
            names["torque_pressure"].py_func(q, tau, c),
            names["pressure_torque"].py_func(q, f, c),
        ]
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


@pytest.mark.parametrize("make", [nominal_leg, ideal_leg])
def test_the_compiled_leg_is_the_symbolic_one(make: Callable[[], Morphology]) -> None:
    m = make()
    k = Kinematics(m)
    names = vars(compiled._model(compiled.structure(m), "swing"))
    c = compiled.prepared(m, "swing")
    area = np.array([a.area for a in m.actuators])
    rng = np.random.default_rng(1)
    for _ in range(20):
        q = rng.uniform([0.3, -0.2], [2.8, 2.2])
        p, tau = rng.uniform(0, 5e4, 2), rng.normal(0, 1, 2)
        np.testing.assert_allclose(names["actuator_lengths"](tuple(q), c), k.lengths(q), rtol=1e-12)
        np.testing.assert_allclose(names["static_pressure"](tuple(q), c), k.static_pressure(q), rtol=1e-9)
        np.testing.assert_allclose(names["pressure_torque"](tuple(q), tuple(p), c), k.jacobian(q).T @ (area * p))
        np.testing.assert_allclose(
            names["torque_pressure"](tuple(q), tuple(tau), c), np.linalg.solve(k.jacobian(q).T * area, tau), rtol=1e-8
        )
    np.testing.assert_allclose(names["actuator_areas"](c), area)


def test_one_structure_shares_one_kernel_and_another_has_its_own() -> None:
    kernel = compiled.load(nominal_leg(), "swing", loop_kernel)
    assert compiled.load(ideal_leg(), "swing", loop_kernel) is kernel
    assert compiled.load(nominal_leg(), "stance", loop_kernel) is not kernel


def test_generated_files_lie_whole_in_the_folder_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "new" / "cache"
    monkeypatch.setenv("EQUIMUS_CACHE", str(folder))
    assert compiled.cache_folder() == folder
    # Past the memory of what was made already, to the files.
    make = compiled._model.__wrapped__
    form = compiled.structure(random_morphology("one_joint", 0))
    first = make(form, "swing")
    files = sorted(path.name for path in folder.iterdir() if path.is_file())
    assert files == [Path(first.__file__ or "").name]
    assert make(form, "swing").__file__ == first.__file__
    assert make(form, "stance").__file__ != first.__file__


def test_a_folder_that_cannot_be_written_is_replaced_by_a_temporary_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    monkeypatch.setenv("EQUIMUS_CACHE", str(blocked / "cache"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    folder = compiled.cache_folder()
    assert folder.is_dir()
    assert folder.parent == tmp_path


def test_a_mark_says_that_a_kernel_was_compiled_in_this_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = compiled.load(nominal_leg(), "swing", loop_kernel)
    monkeypatch.setenv("EQUIMUS_CACHE", str(tmp_path))
    assert not compiled.is_marked_compiled(kernel)
    compiled.mark_compiled(kernel)
    assert compiled.is_marked_compiled(kernel)
    compiled.mark_compiled(kernel)
    assert not compiled.is_marked_compiled(compiled.load(nominal_leg(), "stance", loop_kernel))
