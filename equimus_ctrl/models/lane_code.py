"""CasADi SX expressions as machine code that works on many parameter sets side by side, by LLVM.

Each function runs over all lanes at once: its values are vectors of as many doubles, which LLVM cuts to the registers
that the computer has. Written as Python for numba the same takes ten times as long to compile and a third longer to
run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import llvmlite.binding as llvm  # type: ignore[import-untyped, unused-ignore]
from llvmlite import ir  # type: ignore[import-untyped, unused-ignore]

from equimus_ctrl.errors import ModelError
from equimus_ctrl.models.codegen import Routine, inverted, literal, parameters_alone, steps_of

ROUND = 6755399441055744.0
"""1.5·2⁵²: added and taken away again, it rounds a double to a whole number."""
PI = 3.1415926534682512, 1.2154201013012384e-10
"""π in two parts, the first with so few digits that its product with a whole number is exact (Cody & Waite, 1980)."""
SIN = (
    -0.16666666666666666, 0.008333333333333316, -0.00019841269841254974, 2.7557319219163183e-06,
    -2.5052107616990068e-08, 1.60589773120677e-10, -7.643970284142959e-13, 2.7314446091851363e-15,
)  # fmt: skip
"""Of (sin √s/√s − 1)/s and, below, (cos √s − 1)/s for 0 ≤ √s ≤ π/2, through Chebyshev's nodes."""
COS = (
    -0.5, 0.04166666666666634, -0.0013888888888860709, 2.4801587292446122e-05,
    -2.7557317767308945e-07, 2.087663086667205e-09, -1.1464689861744774e-11, 4.6276756860773096e-14,
)  # fmt: skip

_ARITHMETIC = {ca.OP_ADD: "fadd", ca.OP_SUB: "fsub", ca.OP_MUL: "fmul", ca.OP_DIV: "fdiv"}
_COMPARED = {ca.OP_LT: "<", ca.OP_LE: "<=", ca.OP_EQ: "=="}
_INTRINSIC = {ca.OP_SQRT: "sqrt", ca.OP_FABS: "fabs", ca.OP_EXP: "exp", ca.OP_LOG: "log"}
_LIBRARY = {
    ca.OP_TAN: "tan", ca.OP_TANH: "tanh", ca.OP_ASIN: "asin", ca.OP_ACOS: "acos", ca.OP_ATAN: "atan",
    ca.OP_SINH: "sinh", ca.OP_COSH: "cosh", ca.OP_LOG1P: "log1p", ca.OP_EXPM1: "expm1", ca.OP_HYPOT: "hypot",
    ca.OP_ERF: "erf", ca.OP_ATAN2: "atan2", ca.OP_POW: "pow", ca.OP_CONSTPOW: "pow",
}  # fmt: skip
_DOUBLE, _INDEX = ir.DoubleType(), ir.IntType(64)


@dataclass(frozen=True)
class LaneRoutine(Routine):
    """One function to generate that works on many parameter sets side by side.

    Attributes:
        rows: input name → the row of the work array where its first entry stands.
        result: the row where the output's first entry goes.
        contracts: whether products and sums may be rounded once together.
    """

    rows: Mapping[str, int]
    result: int
    contracts: bool = True


@dataclass(frozen=True)
class LaneCode:
    """Machine code of lanes.

    Attributes:
        code: an object file.
        names: of its functions beside ``prepare``, without their prefix.
        rows: that the work array has in all.
    """

    code: bytes
    names: tuple[str, ...]
    rows: int


def generate_lanes(
    routines: Sequence[LaneRoutine], parameters: ca.SX, lanes: int, prefix: str, constants_row: int
) -> LaneCode:
    """``prefix_prepare(double *p, double *w, int64 l)``, and ``prefix_name(double *w)`` for each routine.

    The work array w is flat: entry l of row r stands at r·lanes + l. ``prepare`` writes what depends on the parameters
    p alone into lane l.

    Args:
        routines: what to generate.
        parameters: the SX symbol vector p.
        lanes: how many there are.
        prefix: of the symbols.
        constants_row: the first row that the constants may take.

    Raises:
        ModelError: for an operation that has no such form.
    """
    module = ir.Module(name=prefix)
    pointer = _DOUBLE.as_pointer()
    first = ir.Function(module, ir.FunctionType(ir.VoidType(), [pointer, pointer, _INDEX]), f"{prefix}_prepare")
    _, work, lane = first.args
    alone = _Values(module, ir.IRBuilder(first.append_basic_block()), 1)
    kept: dict[str, int] = {}

    def kept_row(value: Any) -> int:
        """The row where ``prepare`` puts a value."""
        name = value.get_reference()
        if name not in kept:
            kept[name] = constants_row + len(kept)
            at = alone.builder.add(lane, ir.Constant(_INDEX, kept[name] * lanes))
            alone.builder.store(value, alone.builder.gep(work, [at]))
        return kept[name]

    for routine in routines:
        kind = ir.FunctionType(ir.VoidType(), [pointer])
        function = ir.Function(module, kind, f"{prefix}_{routine.name}")
        own = _Values(module, ir.IRBuilder(function.append_basic_block()), lanes, routine.contracts)
        _write(routine, parameters, own, alone, kept_row)
    alone.builder.ret_void()
    return LaneCode(_compiled(module), tuple(routine.name for routine in routines), constants_row + len(kept))


def _write(
    routine: LaneRoutine, parameters: ca.SX, own: _Values, alone: _Values, kept_row: Callable[[Any], int]
) -> None:
    """One function, and in ``alone`` what of it depends on the parameters alone."""
    function = routine.function(parameters)
    steps = steps_of(function)
    constant = parameters_alone(steps, len(routine.inputs))
    inverses, rows = inverted(steps, constant), [routine.rows[name] for name in routine.inputs]
    work, numbers = own.builder.function.args[0], alone.builder.function.args[0]
    values: list[Any] = []
    read: dict[int, Any] = {}
    results: list[tuple[Any, int]] = []

    def in_lanes(k: int) -> Any:
        """A step's value in all lanes."""
        if not constant[k]:
            return values[k]
        if isinstance(values[k], float):
            return own.number(values[k])
        row = kept_row(values[k])
        if row not in read:
            read[row] = own.load(work, row * own.width)
        return read[row]

    for k, step in enumerate(steps):
        if step.operation == ca.OP_CONST:
            literal(step.value)
            values.append(step.value)
        elif step.operation == ca.OP_INPUT:
            argument, entry = step.place
            if argument == len(rows):
                values.append(alone.load(numbers, entry))
            else:
                values.append(own.load(work, (rows[argument] + entry) * own.width))
        elif step.operation == ca.OP_OUTPUT:
            results.append((in_lanes(step.arguments[0]), (routine.result + step.place[1]) * own.width))
            values.append(None)
        elif constant[k]:
            given = [alone.number(v) if isinstance(v := values[a], float) else v for a in step.arguments]
            values.append(alone.operate(step.operation, given, routine.name))
        elif k in inverses:
            below = step.arguments[1]
            if constant[below]:
                known = alone.number(values[below]) if isinstance(values[below], float) else values[below]
                row = kept_row(alone.operate(ca.OP_INV, [known], routine.name))
                inverse = own.load(work, row * own.width)
            else:
                inverse = own.operate(ca.OP_INV, [values[below]], routine.name)
            values.append(own.operate(ca.OP_MUL, [in_lanes(step.arguments[0]), inverse], routine.name))
        else:
            values.append(own.operate(step.operation, [in_lanes(a) for a in step.arguments], routine.name))
    # Results may take the place of inputs, so that all of these are read before.
    for value, index in results:
        own.store(value, work, index)
    own.builder.ret_void()


class _Values:
    """Instructions for numbers, or vectors of them; the same is not worked out twice.

    Args:
        module: that gets them.
        builder: of a function in it.
        width: how many numbers a value has.
        contracts: whether products and sums may be rounded once together.
    """

    def __init__(self, module: Any, builder: Any, width: int, contracts: bool = True) -> None:
        self.module, self.builder, self.width = module, builder, width
        self.flags = ("contract",) if contracts else ()
        self.kind = ir.VectorType(_DOUBLE, width) if width > 1 else _DOUBLE
        self._known: dict[Hashable, Any] = {}

    def number(self, value: float) -> Any:
        """The same number in all lanes."""
        return ir.Constant(self.kind, [value] * self.width if self.width > 1 else value)

    def load(self, array: Any, index: int) -> Any:
        """Numbers from an index of an array on."""
        key = ("load", array.get_reference(), index)
        if key not in self._known:
            self._known[key] = self.builder.load(self._at(array, index), align=8, typ=self.kind)
        return self._known[key]

    def store(self, value: Any, array: Any, index: int) -> None:
        """Put them there."""
        self.builder.store(value, self._at(array, index), align=8)

    def _at(self, array: Any, index: int) -> Any:
        place = self.builder.gep(array, [ir.Constant(_INDEX, index)])
        return place if self.width == 1 else self.builder.bitcast(place, self.kind.as_pointer())

    def operate(self, operation: int, values: Sequence[Any], name: str) -> Any:
        """One of CasADi's operations.

        Raises:
            ModelError: where it has no form here.
        """
        key = (operation, *(v.get_reference() for v in values))
        if key not in self._known:
            self._known[key] = self._made(operation, values, name)
        return self._known[key]

    def _made(self, operation: int, values: Sequence[Any], name: str) -> Any:
        b, one, none = self.builder, self.number(1.0), self.number(0.0)
        if operation in _ARITHMETIC:
            return getattr(b, _ARITHMETIC[operation])(*values, flags=self.flags)
        if operation in _COMPARED:
            return b.select(b.fcmp_ordered(_COMPARED[operation], *values), one, none)
        if operation in _INTRINSIC:
            return self._intrinsic(_INTRINSIC[operation], values)
        if operation in (ca.OP_SIN, ca.OP_COS):
            sine = operation == ca.OP_SIN
            return self._wave(values[0], sine) if self.width > 1 else self._intrinsic("sin" if sine else "cos", values)
        if operation in _LIBRARY:
            return self._library(_LIBRARY[operation], values)
        if operation == ca.OP_INV:
            return b.fdiv(one, values[0])
        if operation == ca.OP_NEG:
            return b.fneg(values[0])
        if operation == ca.OP_SQ:
            return b.fmul(values[0], values[0], flags=self.flags)
        if operation == ca.OP_TWICE:
            return b.fadd(values[0], values[0], flags=self.flags)
        if operation == ca.OP_ASSIGN:
            return values[0]
        if operation in (ca.OP_FMIN, ca.OP_FMAX):
            return b.select(b.fcmp_ordered("<" if operation == ca.OP_FMIN else ">", *values), *values)
        if operation == ca.OP_IF_ELSE_ZERO:
            return b.select(self._true(values[0]), values[1], none)
        if operation == ca.OP_NE:
            return b.select(b.fcmp_unordered("!=", *values), one, none)
        if operation == ca.OP_NOT:
            return b.select(self._true(values[0]), none, one)
        if operation == ca.OP_AND:
            return b.select(b.and_(*(self._true(v) for v in values)), one, none)
        if operation == ca.OP_OR:
            return b.select(b.or_(*(self._true(v) for v in values)), one, none)
        if operation == ca.OP_SIGN:
            below = b.select(b.fcmp_ordered("<", values[0], none), self.number(-1.0), none)
            return b.select(b.fcmp_ordered(">", values[0], none), one, below)
        raise ModelError(f"{name}: CasADi operation {operation} has no form in the compiled engine")

    def _true(self, value: Any) -> Any:
        return self.builder.fcmp_unordered("!=", value, self.number(0.0))

    def _intrinsic(self, name: str, values: Sequence[Any]) -> Any:
        of = f"v{self.width}f64" if self.width > 1 else "f64"
        kind = ir.FunctionType(self.kind, [self.kind])
        return self.builder.call(self.module.declare_intrinsic(f"llvm.{name}.{of}", (), kind), values)

    def _library(self, name: str, values: Sequence[Any]) -> Any:
        """A function of C's mathematical library, lane by lane."""
        kind = ir.FunctionType(_DOUBLE, [_DOUBLE] * len(values))
        function = self.module.globals.get(name) or ir.Function(self.module, kind, name)
        if self.width == 1:
            return self.builder.call(function, values)
        found = ir.Constant(self.kind, ir.Undefined)
        for lane in range(self.width):
            at = ir.Constant(ir.IntType(32), lane)
            given = [self.builder.extract_element(v, at) for v in values]
            found = self.builder.insert_element(found, self.builder.call(function, given), at)
        return found

    def _wave(self, x: Any, sine: bool) -> Any:
        """Sine or cosine of x to 4e-16 for |x| below 1e5: reduced to ±π/2, then a polynomial.

        No branch, not even a choice between two numbers; the polynomial in pairs (Estrin), so that little waits for
        another.
        """
        key = ("reduced", x.get_reference())
        if key not in self._known:
            half_turns = self._whole(self._product(x, self.number(1 / math.pi)))
            rest = x
            for part in PI:
                rest = self._sum(rest, self._product(half_turns, self.number(-part)))
            odd = self._sum(
                half_turns, self._product(self._whole(self._product(half_turns, self.number(0.5))), self.number(-2.0))
            )
            sign = self._sum(self.number(1.0), self._product(self._intrinsic("fabs", [odd]), self.number(-2.0)))
            square = self._product(rest, rest)
            self._known[key] = rest, sign, square, self._product(square, square)
        rest, sign, square, fourth = self._known[key]
        c = [self.number(value) for value in (SIN if sine else COS)]
        pairs = [self._sum(c[k], self._product(square, c[k + 1])) for k in (0, 2, 4, 6)]
        low, high = (self._sum(pairs[k], self._product(fourth, pairs[k + 1])) for k in (0, 2))
        series = self._product(square, self._sum(low, self._product(self._product(fourth, fourth), high)))
        whole = self._sum(rest, self._product(rest, series)) if sine else self._sum(self.number(1.0), series)
        return self._product(sign, whole)

    def _sum(self, a: Any, b: Any) -> Any:
        return self.builder.fadd(a, b, flags=self.flags)

    def _product(self, a: Any, b: Any) -> Any:
        return self.builder.fmul(a, b, flags=self.flags)

    def _whole(self, x: Any) -> Any:
        """The nearest whole number; nothing may be contracted here."""
        return self.builder.fsub(self.builder.fadd(x, self.number(ROUND)), self.number(ROUND))


def computer() -> str:
    """What machine code depends on beside its source."""
    return f"{llvm.llvm_version_info} {llvm.get_host_cpu_name()} {llvm.get_host_cpu_features().flatten()}"


def target_machine() -> Any:
    """LLVM's of this computer."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=2, codemodel="jitdefault"
    )


def _compiled(module: Any) -> bytes:
    machine = target_machine()
    module.triple, module.data_layout = llvm.get_default_triple(), str(machine.target_data)
    parsed = llvm.parse_assembly(str(module))
    parsed.verify()
    code: bytes = machine.emit_object(parsed)
    return code
