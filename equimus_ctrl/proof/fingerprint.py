"""By what an answer was made: the code of all that a diagnosis is made of, and its settings."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import pkgutil
from collections.abc import Iterator, Sequence
from functools import cache

PARTS = ("diagnosis", "effects", "engines", "identification", "models", "robots")
"""Parts of the package that decide what a diagnosis says."""
BASELINES = ("proof.baselines", "proof.refits", "proof.sindy_baseline", "proof.torques")
"""What the baselines add to that."""


def fingerprint(settings: str = "", parts: Sequence[str] = PARTS) -> str:
    """SHA-256 of what some parts of the package do, and of settings as text.

    Covered are the syntax trees of all modules of these parts: names, constants, operators, annotations, the order of
    statements. Comments, docstrings, blank lines and formatting are not. Nor is what lies outside the parts: the rest
    of the package, the versions of Python and of the libraries, the computer. An answer of another version of these
    stays; whoever wants it anew removes it. A version of Python whose parser builds another tree for the same source
    has fingerprints of its own.
    """
    found = hashlib.sha256(settings.encode())
    for part in parts:
        for name, source in _sources(f"equimus_ctrl.{part}"):
            found.update(f"\n{name}\n{_digest(source)}".encode())
    return found.hexdigest()


@cache
def _digest(source: str) -> str:
    """SHA-256 of a module's syntax tree without docstrings, the strings beneath constants among them."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        for field, value in ast.iter_fields(node):
            if isinstance(value, list) and value and isinstance(value[0], ast.stmt):
                setattr(node, field, [statement for statement in value if not _idle(statement)])
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def _idle(statement: ast.stmt) -> bool:
    """Whether it is a string and nothing else, which does nothing wherever it stands."""
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


def _sources(name: str) -> Iterator[tuple[str, str]]:
    """(name, source) of a module and of all below it, by name; none of it is run that is not loaded anyway."""
    spec = importlib.util.find_spec(name)
    if spec is None:
        raise ModuleNotFoundError(name)
    yield name, _source(spec.loader, name)
    for info in sorted(pkgutil.iter_modules(spec.submodule_search_locations or []), key=lambda info: info.name):
        yield from _sources(f"{name}.{info.name}")


def _source(loader: object, name: str) -> str:
    return str(loader.get_source(name)) if hasattr(loader, "get_source") else ""
