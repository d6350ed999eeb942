"""The page of what ``import equimus_ctrl as eq`` offers, from the stub that decides that."""

from __future__ import annotations

import ast
from pathlib import Path

GROUPS = {
    "Work with recordings and models": ("workflow", "recordings", "options"),
    "Run and control": ("loop", "controllers", "estimation", "predictive", "scenarios", "plants", "testing"),
    "Robots and their simulation": ("robots", "models", "engines"),
    "Effects": ("effects",),
    "Types and errors": ("types", "errors"),
}
"""Heading → packages whose names stand under it; a package that is in none has a heading of its own."""


def page(stub: Path) -> str:
    """One entry a name, from its docstring."""
    parts = ["# Python", "What `import equimus_ctrl as eq` offers: `eq.NAME`. Names are imported on first use."]
    left = names(stub)
    headings = {**GROUPS, **{package: (package,) for package, *_ in left if package not in sum(GROUPS.values(), ())}}
    for heading, packages in headings.items():
        entries = [entry for package in packages for entry in left if entry[0] == package]
        if entries:
            parts.append(f"## {heading}")
            parts += [f"::: equimus_ctrl.{path}" for _, path in entries]
    return "\n\n".join(parts) + "\n"


def names(stub: Path) -> list[tuple[str, str]]:
    """Package and path of each name that the stub offers, in its order."""
    found = []
    for node in ast.parse(stub.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                path = f"{node.module}.{alias.name}" if node.module else alias.name
                found.append((path.partition(".")[0], path))
    return found
