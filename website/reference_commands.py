"""The page of commands, from the application itself."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

import typer

from equimus_ctrl.cli.main import app

OPTION = re.compile(r"(?<![\w`-])--[a-z][a-z-]*[a-z]\b")
TAG = re.compile(r"\[/?(?:bold|dim|italic|/)\]")


def page() -> str:
    """All verbs with their arguments, options and examples."""
    root = typer.main.get_command(app)
    top = root.make_context("equimus-ctrl", [], resilient_parsing=True)
    parts = [
        "# Commands",
        "Made from the command itself when this site was built; `equimus-ctrl VERB --help` says the same.",
        "`equimus-ctrl --version` prints the version; `equimus-ctrl --install-completion` sets up "
        "[completion](../completion.md). `python -m equimus_ctrl` is the same command.",
        _exit_codes(root),
    ]
    for verb, context in commands(top):
        parts += _verb(verb, context)
    return "\n\n".join(parts) + "\n"


def commands(context: Any) -> Iterator[tuple[Any, Any]]:
    """Every command that does something, in the order of ``--help``, with its context."""
    group = context.command
    for name in group.list_commands(context) if hasattr(group, "list_commands") else ():
        command = group.get_command(context, name)
        below = type(context)(command, parent=context, info_name=name)
        if hasattr(command, "list_commands"):
            yield from commands(below)
        elif not command.hidden:
            yield command, below


def _exit_codes(root: Any) -> str:
    title, _, codes = TAG.sub("", root.epilog or "").partition("  ")
    lines = [line.strip() for line in " ".join(codes.split()).split("·")]
    return "\n".join([f"**{title}:**", "", *(f"- **{line.split()[0]}** {line.partition(' ')[2]}" for line in lines)])


def _verb(command: Any, context: Any) -> list[str]:
    what, examples = _help(command)
    parts = [f"## {context.command_path.removeprefix('equimus-ctrl ')}", what]
    usage = [context.command_path, *command.collect_usage_pieces(context)]
    parts.append(f"```text\n{' '.join(usage)}\n```")
    if examples:
        parts.append("```sh\n" + "\n".join(examples) + "\n```")
    rows = [_row(parameter, context) for parameter in command.get_params(context) if parameter.get_help_record(context)]
    parts.append("\n".join(["| argument or option | what it does | default |", "| --- | --- | --- |", *rows]))
    return parts


def _help(command: Any) -> tuple[str, list[str]]:
    """What a command does, as paragraphs, and its examples."""
    paragraphs, examples = [], []
    for paragraph in inspect.cleandoc(command.help or "").split("\n\n"):
        lines = TAG.sub("", paragraph).replace("\b", "").strip().splitlines()
        if lines and lines[0].strip() == "Examples":
            examples = [line.strip() for line in lines[1:]]
        elif lines:
            paragraphs.append(" ".join(line.strip() for line in lines))
    return "\n\n".join(_escaped(text) for text in paragraphs), examples


def _row(parameter: Any, context: Any) -> str:
    names, text = parameter.get_help_record(context)
    text, _, default = TAG.sub("", text).partition("[default: ")
    text = _escaped(text).replace("|", chr(92) + "|")  # within code a bar is no end of a cell, and a backslash stays
    shown = f"`{default.rstrip(']')}`" if default else ""
    return f"| {_named(names.strip())} | {text} | {shown} |"


def _named(text: str) -> str:
    """Names of an option, between which a line may end, and what stands for its value, which may come in the next."""
    names, value = re.fullmatch(r"((?:-\S+(?: /)? ?)+|\S+ ?)(.*)", text).groups()
    shown = re.sub(r"[^\s,/]+", r"`\g<0>`", names.strip())
    return f"{shown} `{value}`" if value else shown


def _escaped(text: str) -> str:
    """Text of a terminal as Markdown: what would be read as emphasis or HTML is not, and options are code."""
    text = " ".join(text.split()).replace("`", "'").replace("<", "&lt;").replace(">", "&gt;")
    return OPTION.sub(r"`\g<0>`", re.sub(r"([*_])", r"\\\1", text))
