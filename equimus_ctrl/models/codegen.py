"""CasADi SX expressions written out as scalar Python source for numba.

Work that depends on the parameter vector alone is separated out and done once a run: ``prepare(p)`` returns the
constants that every other generated function takes as its last argument.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

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


def _generate_one(routine: Routine, parameters: ca.SX, offset: int) -> tuple[str, list[str], list[str]]:
    """(source, lines for prepare, names of the prepared values needed) of one routine."""
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
            index = needed.setdefault(name, offset + len(needed))
            return f"c[{index}]"
        return name

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
                raise NotImplementedError(f"CasADi operation {op} has no source form yet")
            values = [work[i] for i in ins]
            constant = all(value[1] for value in values)
            arguments = [use(value, constant) for value in values]
            name = f"{tag}{k}" if constant else f"w{k}"
            line = f"    {name} = {_BINARY[op].format(*[f'({a})' if a[0] == '-' else a for a in arguments])}\n"
            (prepare if constant else body).append(line)
            work[outs[0]] = (name, constant)

    header = f"def {routine.name}({', '.join([*routine.inputs, 'c'])}):\n"
    unpack = "".join(
        _unpack([f"{name}{i}" for i in range(symbol.numel())], name) for name, symbol in routine.inputs.items()
    )
    result = ", ".join(outputs[i] for i in range(dense.numel()))
    return f"{header}{unpack}{''.join(body)}    return ({result},)\n", prepare, list(needed)
