"""CasADi SX expressions written out as scalar Python source for numba.

Work that depends on the parameter vector alone is separated out and done once a run: ``prepare(p)`` returns the
constants that every other generated function takes as its last argument.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from equimus_ctrl.errors import ModelError

_BINARY = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_POW: "{0} ** {1}",
    ca.OP_CONSTPOW: "{0} ** {1}",
    ca.OP_LT: "1.0 if {0} < {1} else 0.0",
    ca.OP_LE: "1.0 if {0} <= {1} else 0.0",
    ca.OP_EQ: "1.0 if {0} == {1} else 0.0",
    ca.OP_NE: "1.0 if {0} != {1} else 0.0",
    ca.OP_AND: "1.0 if {0} != 0.0 and {1} != 0.0 else 0.0",
    ca.OP_OR: "1.0 if {0} != 0.0 or {1} != 0.0 else 0.0",
    ca.OP_FMIN: "{0} if {0} < {1} else {1}",
    ca.OP_FMAX: "{0} if {0} > {1} else {1}",
    ca.OP_IF_ELSE_ZERO: "{1} if {0} != 0.0 else 0.0",
    ca.OP_ATAN2: "math.atan2({0}, {1})",
    ca.OP_ASSIGN: "{0}",
    ca.OP_NEG: "-{0}",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "2.0 * {0}",
    ca.OP_NOT: "1.0 if {0} == 0.0 else 0.0",
    ca.OP_SQRT: "math.sqrt({0})",
    ca.OP_SIN: "math.sin({0})",
    ca.OP_COS: "math.cos({0})",
    ca.OP_TAN: "math.tan({0})",
    ca.OP_EXP: "math.exp({0})",
    ca.OP_LOG: "math.log({0})",
    ca.OP_TANH: "math.tanh({0})",
    ca.OP_FABS: "abs({0})",
    ca.OP_SIGN: "1.0 if {0} > 0.0 else (-1.0 if {0} < 0.0 else 0.0)",
    ca.OP_ASIN: "math.asin({0})",
    ca.OP_ACOS: "math.acos({0})",
    ca.OP_ATAN: "math.atan({0})",
    ca.OP_SINH: "math.sinh({0})",
    ca.OP_COSH: "math.cosh({0})",
    ca.OP_LOG1P: "math.log1p({0})",
    ca.OP_EXPM1: "math.expm1({0})",
    ca.OP_HYPOT: "math.hypot({0}, {1})",
    ca.OP_ERF: "math.erf({0})",
}


@dataclass(frozen=True)
class Routine:
    """One function to generate.

    Attributes:
        name: of the generated function.
        inputs: argument name → SX symbol vector; each becomes a tuple argument.
        output: SX expression; its entries, column by column, become the returned tuple.
    """

    name: str
    inputs: Mapping[str, ca.SX]
    output: ca.SX


def _literal(value: float) -> str:
    if value != value or value in (float("inf"), float("-inf")):
        raise ValueError(f"a generated expression holds the constant {value}")
    return repr(float(value))


def _unpack(names: Sequence[str], source: str) -> str:
    return f"    {', '.join(names)}{',' if len(names) == 1 else ''} = {source}\n"


def generate(routines: Sequence[Routine], parameters: ca.SX, decorator: str) -> str:
    """Source text of ``prepare(p)`` and of one function for each routine.

    ``prepare`` takes the parameter array and returns a 1-D array of constants; every routine takes its tuples,
    then those constants, and returns a tuple of floats.

    Args:
        routines: what to generate.
        parameters: the SX symbol vector p.
        decorator: a line put before every function.
    """
    constants: list[str] = []
    prepare_lines: list[str] = []
    bodies: list[str] = []
    for routine in routines:
        body, lines, needed = _generate_one(routine, parameters, len(constants))
        prepare_lines += lines
        constants += needed
        bodies.append(f"{decorator}\n{body}")
    n = parameters.numel()
    store = "".join(f"    c[{i}] = {name}\n" for i, name in enumerate(constants))
    unpack = "".join(f"    p{i} = p[{i}]\n" for i in range(n))
    prepare = (
        f"{decorator}\ndef prepare(p):\n{unpack}{''.join(prepare_lines)}"
        f"    c = np.empty({max(len(constants), 1)})\n{store}    return c\n"
    )
    return "\n\n".join([prepare, *bodies])


@dataclass(frozen=True)
class LaneRoutine(Routine):
    """One function to generate that works on many parameter sets side by side.

    Attributes:
        rows: input name → the row of the work array where its first entry stands.
        result: the row where the output's first entry goes.
    """

    rows: Mapping[str, int]
    result: int


def generate_lanes(
    routines: Sequence[LaneRoutine], parameters: ca.SX, options: str, prefix: str, constants_row: int
) -> tuple[str, int]:
    """Source text of ``prepare_lane(p, w, l)`` and of a function ``name(w)`` for each routine; (text, rows in all).

    The work array w is flat: entry l of row r stands at r·LANES + l, and each function runs over all lanes l in one
    loop without branches, which the compiler turns into vector instructions. Sines and cosines are those of
    ``lane_sin`` and ``lane_cos``.

    Each is a C function, called by its symbol: as a callee of compiled functions numba would optimise its long body
    again in every one of them.

    Args:
        routines: what to generate.
        parameters: the SX symbol vector p.
        options: of numba's ``cfunc``, after its signature.
        prefix: of the symbols.
        constants_row: the first row that the constants may take.
    """
    count = 0
    prepare_lines: list[str] = []
    stores: list[str] = []
    bodies: list[str] = []
    for routine in routines:
        written = _write(
            routine, parameters, count, lambda index: f"w[{constants_row + index} * LANES + l]", _LANE_FUNCTIONS
        )
        prepare_lines += written.prepare
        stores += [f"    w[{constants_row + count + i} * LANES + l] = {n}\n" for i, n in enumerate(written.constants)]
        count += len(written.constants)
        loads = [
            f"    {name}{i} = w[{routine.rows[name] + i} * LANES + l]\n"
            for name, symbol in routine.inputs.items()
            for i in range(symbol.numel())
        ]
        saves = [f"    w[{routine.result + i} * LANES + l] = {value}\n" for i, value in enumerate(written.outputs)]
        loop = "".join(f"    {line}" for line in [*loads, *written.body, *saves]) or "        pass\n"
        bodies.append(f"    for l in range(LANES):\n{loop}")
    rows = constants_row + count
    unpack = "".join(f"    p{i} = p[{i}]\n" for i in range(parameters.numel()))
    parts = [
        f'@cfunc("void(CPointer(float64), CPointer(float64), intp)", {options})\n'
        f"def _prepare(numbers, work, l):\n    p = carray(numbers, {max(parameters.numel(), 1)})\n"
        f"    w = carray(work, {rows} * LANES)\n{unpack}{''.join(prepare_lines)}{''.join(stores)}\n"
        f'add_symbol("{prefix}_prepare", _prepare.address)\n'
        f'_C_prepare = ExternalFunction("{prefix}_prepare", void(CPointer(float64), CPointer(float64), intp))\n\n\n'
        f"@njit({options})\ndef prepare_lane(p, w, l):\n    _C_prepare(p.ctypes, w.ctypes, l)\n"
    ]
    for routine, body in zip(routines, bodies, strict=True):
        name, symbol = routine.name, f"{prefix}_{routine.name}"
        parts.append(
            f'@cfunc("void(CPointer(float64))", {options})\ndef _{name}(work):\n'
            f"    w = carray(work, {rows} * LANES)\n{body}\n"
            f'add_symbol("{symbol}", _{name}.address)\n'
            f'_C_{name} = ExternalFunction("{symbol}", void(CPointer(float64)))\n\n\n'
            f"@njit({options})\ndef {name}(w):\n    _C_{name}(w.ctypes)\n"
        )
    return "\n\n".join(parts), rows


_LANE_FUNCTIONS = {ca.OP_SIN: "lane_sin({0})", ca.OP_COS: "lane_cos({0})"}


@dataclass(frozen=True)
class _Written:
    """Source lines of one routine.

    Attributes:
        prepare: what depends on the parameters alone.
        constants: names that ``prepare`` makes and the body needs.
        body: the rest.
        outputs: what the output's entries are called.
    """

    prepare: list[str]
    constants: list[str]
    body: list[str]
    outputs: list[str]


def _generate_one(routine: Routine, parameters: ca.SX, offset: int) -> tuple[str, list[str], list[str]]:
    """(source, lines for prepare, names of the prepared values needed) of one routine."""
    written = _write(routine, parameters, offset, lambda index: f"c[{index}]", {})
    header = f"def {routine.name}({', '.join([*routine.inputs, 'c'])}):\n"
    unpack = "".join(
        _unpack([f"{name}{i}" for i in range(symbol.numel())], name) for name, symbol in routine.inputs.items()
    )
    source = f"{header}{unpack}{''.join(written.body)}    return ({', '.join(written.outputs)},)\n"
    return source, written.prepare, written.constants


def _write(
    routine: Routine, parameters: ca.SX, offset: int, constant_at: Callable[[int], str], functions: Mapping[int, str]
) -> _Written:
    """A routine as lines of source.

    Args:
        routine: what is written.
        parameters: the SX symbol vector p.
        offset: how many constants other routines have taken already.
        constant_at: how the constant of an index is read in the body.
        functions: operation → source form in the body, in place of the usual one.
    """
    symbols = list(routine.inputs.values())
    dense = ca.densify(ca.cse(routine.output))
    function = ca.Function(routine.name, [*symbols, parameters], [dense])
    tag = f"{routine.name}_"
    # Values are (name, is_constant); the work vector is reassigned, so names are made fresh at each assignment.
    work: dict[int, tuple[str, bool]] = {}
    prepare: list[str] = []
    body: list[str] = []
    needed: dict[str, int] = {}
    outputs: dict[int, str] = {}

    def use(value: tuple[str, bool], constant_target: bool) -> str:
        name, constant = value
        if constant and not constant_target and name[0] not in "-0123456789":
            return constant_at(needed.setdefault(name, offset + len(needed)))
        return name

    inverses = _inverses(function)
    inverted: dict[str, str] = {}
    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        ins, outs = function.instruction_input(k), function.instruction_output(k)
        if op == ca.OP_CONST:
            work[outs[0]] = (_literal(function.instruction_constant(k)), True)
        elif op == ca.OP_INPUT:
            argument, entry = ins
            if argument == len(symbols):
                work[outs[0]] = (f"p{entry}", True)
            else:
                work[outs[0]] = (f"{list(routine.inputs)[argument]}{entry}", False)
        elif op == ca.OP_OUTPUT:
            outputs[outs[1]] = use(work[ins[0]], False)
        else:
            if op not in _BINARY:
                raise ModelError(f"{routine.name}: CasADi operation {op} has no source form in the compiled engine")
            values = [work[i] for i in ins]
            constant = all(value[1] for value in values)
            arguments = [use(value, constant) for value in values]
            name = f"{tag}{k}" if constant else f"w{k}"
            form = _BINARY[op] if constant else functions.get(op, _BINARY[op])
            if k in inverses and not constant:
                # A division takes as long as ten products.
                below, known = values[1]
                if below not in inverted:
                    inverted[below] = f"{tag}{k}i" if known else f"w{k}i"
                    (prepare if known else body).append(f"    {inverted[below]} = 1.0 / {below}\n")
                form, arguments[1] = _BINARY[ca.OP_MUL], use((inverted[below], known), False)
            line = f"    {name} = {form.format(*[f'({a})' if a[0] == '-' else a for a in arguments])}\n"
            (prepare if constant else body).append(line)
            work[outs[0]] = (name, constant)
    return _Written(prepare, list(needed), body, [outputs[i] for i in range(dense.numel())])


def _inverses(function: ca.Function) -> set[int]:
    """Divisions, as instructions, that share their denominator with others."""
    current: dict[int, int] = {}
    below: dict[int, list[int]] = {}
    for k in range(function.n_instructions()):
        op, ins = function.instruction_id(k), function.instruction_input(k)
        if op == ca.OP_DIV:
            below.setdefault(current[ins[1]], []).append(k)
        if op != ca.OP_OUTPUT:
            current[function.instruction_output(k)[0]] = k
    return {k for divisions in below.values() if len(divisions) > 1 for k in divisions}
