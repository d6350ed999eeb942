"""The pages of what ``import equimus_ctrl as eq`` offers, from the stub that decides that."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import griffe
from markup import breakable

INDEX, FOLDER = "reference/python.md", "reference/python"
"""The page that lists all names, and where the pages stand that describe them."""


@dataclass(frozen=True)
class Section:
    """A page.

    Attributes:
        name: of its file.
        title: of it.
        packages: whose names stand there.
        note: under the title.
    """

    name: str
    title: str
    packages: tuple[str, ...]
    note: str = ""


SECTIONS = (
    Section("workflow", "Work with recordings and models", ("workflow", "recordings", "identification")),
    Section(
        "options", "Options of the verbs", ("options",),
        "The command line has the [same options](../commands.md); a verb takes one of these or its fields one by one.",
    ),
    Section("control", "Run and control", ("loop", "controllers", "estimation", "learning")),
    Section("scenarios", "Scenarios and plants", ("scenarios", "plants", "testing")),
    Section("robots", "Robots and their simulation", ("robots", "models", "engines")),
    Section(
        "effects", "Effects as classes", ("effects",),
        "Laws, figures, and parameters with units and bounds: [effects](../effects.md).",
    ),
    Section("types", "Types and errors", ("types", "errors")),
)  # fmt: skip
MORE = Section("more", "Types in signatures", (), "What functions take and give beside what `eq` itself offers.")
ENTRY = """::: equimus_ctrl.{path}
    options:
      heading: eq.{name}
      toc_label: {name}"""


def pages(stub: Path) -> dict[str, str]:
    """Path on the site → Markdown: the list of all names, a page of each section, and the types that these name."""
    offered = names(stub)
    made = {INDEX: _index(offered)}
    for section in SECTIONS:
        entries = [path for package in section.packages for own, path in offered if own == package]
        parts = [f"# {section.title}", *filter(None, [section.note])]
        parts += [ENTRY.format(path=path, name=path.rpartition(".")[2]) for path in entries]
        made[f"{FOLDER}/{section.name}.md"] = "\n\n".join(parts) + "\n"
    rows = ["| name | what it is | module |", "| --- | --- | --- |"]
    rows += [_more(path, found, paths) for path, (found, paths) in types(offered).items()]
    made[f"{FOLDER}/{MORE.name}.md"] = "\n\n".join([f"# {MORE.title}", MORE.note, "\n".join(rows)]) + "\n"
    return made


def names(stub: Path) -> list[tuple[str, str]]:
    """Package and path of each name that the stub offers, in its order."""
    found = []
    for node in ast.parse(stub.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                path = f"{node.module}.{alias.name}" if node.module else alias.name
                if node.module and _package()[path].is_module:  # a function that is called as its module
                    path = f"{path}.{alias.name}"
                found.append((path.partition(".")[0], path))
    return found


def types(offered: list[tuple[str, str]]) -> Mapping[str, tuple[Any, set[str]]]:
    """What signatures of what is offered name without its being offered: path → class or alias, all its paths."""
    package = _package()
    own = {package[path].canonical_path for _, path in offered}
    found: dict[str, tuple[Any, set[str]]] = {}
    for _, path in offered:
        for used in _named(_target(package[path])):
            if not used.startswith("equimus_ctrl.") or used.rpartition(".")[2].startswith("_"):
                continue
            target = _target(package[used.removeprefix("equimus_ctrl.")])
            is_type = target.is_class or (target.is_attribute and not _is_variable(target))
            if is_type and target.canonical_path not in own:
                found.setdefault(target.canonical_path, (target, {target.canonical_path}))[1].add(used)
    return dict(sorted(found.items(), key=lambda item: (item[0].rpartition(".")[2].lower(), item[0])))


@cache
def _package() -> Any:
    return griffe.load("equimus_ctrl", search_paths=[str(Path(__file__).resolve().parent.parent)])


def _target(found: Any) -> Any:
    return found.final_target if found.is_alias else found


def _named(found: Any) -> Iterator[str]:
    """Paths of all names in the annotations of a function, or of what a class has for others."""
    if found.is_class:
        for name, member in found.members.items():
            if not member.is_alias and (name == "__init__" or not name.startswith("_")):
                yield from _named(member)
        return
    annotations = [parameter.annotation for parameter in found.parameters] if found.is_function else []
    annotations.append(found.returns if found.is_function else getattr(found, "annotation", None))
    for annotation in annotations:
        if isinstance(annotation, griffe.Expr):
            yield from (part.canonical_path for part in annotation.iterate(flat=True) if _is_name(part))


def _is_name(part: Any) -> bool:
    return isinstance(part, griffe.ExprName)


def _is_variable(found: Any) -> bool:
    return str(found.value).startswith(("TypeVar(", "ParamSpec("))


def _index(offered: list[tuple[str, str]]) -> str:
    parts = [
        "# Python",
        "What `import equimus_ctrl as eq` offers: `eq.NAME`. Names are imported on first use. "
        "[Everything from Python](../library.md) shows how they work together.",
    ]
    for section in SECTIONS:
        entries = [path for package in section.packages for own, path in offered if own == package]
        rows = [f"| {_anchor(path)}{_link(path)} | {_first(_target(_package()[path]))} |" for path in entries]
        parts += [
            f"## [{section.title}](python/{section.name}.md)",
            "\n".join(["| name | what it is |", "| --- | --- |", *rows]),
        ]
    parts += [f"## [{MORE.title}](python/{MORE.name}.md)", MORE.note]
    return "\n\n".join(parts) + "\n"


def _anchor(path: str) -> str:
    """Where links led when all of Python was this page."""
    return f'<span id="equimus_ctrl.{path}"></span>'


def _last(path: str) -> str:
    return path.rpartition(".")[2]


def _link(path: str) -> str:
    return f"[<code>{breakable(f'eq.{_last(path)}')}</code>][equimus_ctrl.{path}]"


def _first(found: Any) -> str:
    """The first sentence of a docstring, or its first paragraph where that is the shorter."""
    paragraph = " ".join((found.docstring.value if found.docstring else "").partition("\n\n")[0].split())
    sentence = re.split(r"(?<=[.:]) (?=[A-Z])", paragraph)[0]
    return re.sub(r"(?<!`)([*<|])(?!`)", r"\\\1", sentence.replace("``", "`"))


def _more(path: str, found: Any, paths: set[str]) -> str:
    text = " ".join(filter(None, [_first(found), "" if found.is_class else f"`{found.value}`"]))
    anchors = "".join(f"[](){{#{one}}}" for one in sorted(paths))
    return f"| {anchors}<code>{breakable(_last(path))}</code> | {text} | `{path.rpartition('.')[0]}` |"
