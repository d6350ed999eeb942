"""CasADi SX expressions written out as scalar Python source for numba.

Work that depends on the parameter vector alone is separated out and done once a run: ``prepare(p)`` returns the
constants that every other generated function takes as its last argument.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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

    def function(self, parameters: ca.SX) -> ca.Function:
        """CasADi's function of the inputs, then the parameters."""
        return ca.Function(self.name, [*self.inputs.values(), parameters], [ca.densify(ca.cse(self.output))])


def literal(value: float) -> str:
    """A number as source.

    Raises:
        ValueError: where it is none.
    """
    if value != value or value in (float("inf"), float("-inf")):
        raise ValueError(f"a generated expression holds the constant {value}")
    return repr(float(value))


@dataclass(frozen=True)
class Step:
    """One instruction of a CasADi function, each value of which is assigned once.

    Attributes:
        operation: CasADi's number of it.
        arguments: the steps whose values it takes.
        place: (argument, entry) of an input, (0, entry) of an output.
        value: of a constant.
    """

    operation: int
    arguments: tuple[int, ...] = ()
    place: tuple[int, int] = (0, 0)
    value: float = 0.0


def steps_of(function: ca.Function) -> list[Step]:
    """The instructions of an SX function."""
    current: dict[int, int] = {}
    steps: list[Step] = []
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        ins, outs = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_CONST:
            steps.append(Step(operation, value=function.instruction_constant(k)))
        elif operation == ca.OP_INPUT:
            steps.append(Step(operation, place=(ins[0], ins[1])))
        elif operation == ca.OP_OUTPUT:
            steps.append(Step(operation, (current[ins[0]],), (outs[0], outs[1])))
            continue
        else:
            steps.append(Step(operation, tuple(current[i] for i in ins)))
        current[outs[0]] = k
    return steps


def parameters_alone(steps: Sequence[Step], argument: int) -> list[bool]:
    """Whether each step's value depends on constants and one argument alone; of outputs it says nothing."""
    found: list[bool] = []
    for step in steps:
        if step.operation == ca.OP_INPUT:
            found.append(step.place[0] == argument)
        else:
            found.append(step.operation != ca.OP_OUTPUT and all(found[a] for a in step.arguments))
    return found


def inverted(steps: Sequence[Step], constant: Sequence[bool]) -> set[int]:
    """Divisions to be products with an inverse: a division takes as long as ten products.

    Those that share their denominator with others, and those of which it is constant.
    """
    below: dict[int, list[int]] = {}
    for k, step in enumerate(steps):
        if step.operation == ca.OP_DIV and not constant[k]:
            below.setdefault(step.arguments[1], []).append(k)
    return {k for by, divisions in below.items() if len(divisions) > 1 or constant[by] for k in divisions}


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
    """(source, lines for ``prepare``, names of the prepared values needed) of one routine.

    Args:
        routine: what is written.
        parameters: the SX symbol vector p.
        offset: how many constants other routines have taken already.
    """
    steps = steps_of(routine.function(parameters))
    constant = parameters_alone(steps, len(routine.inputs))
    inputs = list(routine.inputs)
    names: list[str] = []
    prepare: list[str] = []
    body: list[str] = []
    needed: dict[str, int] = {}
    outputs: dict[int, str] = {}

    def use(k: int, alone: bool = False) -> str:
        name = names[k]
        if constant[k] and not alone and name[0] not in "-0123456789":
            return f"c[{needed.setdefault(name, offset + len(needed))}]"
        return name

    for k, step in enumerate(steps):
        if step.operation == ca.OP_CONST:
            names.append(literal(step.value))
        elif step.operation == ca.OP_INPUT:
            argument, entry = step.place
            names.append(f"p{entry}" if argument == len(inputs) else f"{inputs[argument]}{entry}")
        elif step.operation == ca.OP_OUTPUT:
            outputs[step.place[1]] = use(step.arguments[0])
            names.append("")
        else:
            if step.operation not in _BINARY:
                raise ModelError(
                    f"{routine.name}: CasADi operation {step.operation} has no source form in the compiled engine"
                )
            given = [use(a, constant[k]) for a in step.arguments]
            names.append(f"{routine.name}_{k}" if constant[k] else f"w{k}")
            form = _BINARY[step.operation].format(*[f"({a})" if a[0] == "-" else a for a in given])
            (prepare if constant[k] else body).append(f"    {names[k]} = {form}\n")
    header = f"def {routine.name}({', '.join([*routine.inputs, 'c'])}):\n"
    unpack = "".join(
        _unpack([f"{name}{i}" for i in range(symbol.numel())], name) for name, symbol in routine.inputs.items()
    )
    values = ", ".join(outputs[i] for i in range(routine.output.numel()))
    return f"{header}{unpack}{''.join(body)}    return ({values},)\n", prepare, list(needed)
