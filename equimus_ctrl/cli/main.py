"""The command ``equimus-ctrl``: one verb a file, errors as sentences, exit codes that mean something."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from typing import Annotated, Any

import typer
from typer.exceptions import TyperException

from equimus_ctrl.cli import (
    autotune,
    check,
    compare,
    diagnose,
    emulate,
    experiment,
    export,
    hardware,
    identify,
    list_names,
    prove,
    recordings,
    run,
    score,
    sensitivity,
    train,
    validate,
)
from equimus_ctrl.cli.flags import Command, Group
from equimus_ctrl.computer import keep_freed_memory
from equimus_ctrl.errors import EquimusError, one_line

EXIT_CODES = """\
[bold]Exit codes[/bold]  0 done · 1 a fault of the program · 2 something given is wrong or missing ·
3 nothing within the limits was found, a simulation diverged, an accuracy goal was missed, or a robot was vented ·
130 stopped by Ctrl-C"""

app = typer.Typer(
    name="equimus-ctrl",
    cls=Group,
    help="Simulate, control, tune and diagnose robots driven by linear elastic actuators.",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("autotune", cls=Command)(autotune.autotune)
app.command("autotune-pid", cls=Command)(autotune.autotune_pid)
app.command("run", cls=Command)(run.run)
app.command("compare", cls=Command)(compare.compare)
app.command("emulate", cls=Command)(emulate.emulate)
app.command("export", cls=Command)(export.export)
app.command("score", cls=Command)(score.score)
app.command("validate", cls=Command)(validate.validate)
app.command("identify", cls=Command)(identify.identify)
app.command("check", cls=Command)(check.check)
app.command("diagnose", cls=Command)(diagnose.diagnose)
app.command("prove", cls=Command)(prove.prove)
app.command("sensitivity", cls=Command)(sensitivity.sensitivity)
app.command("train", cls=Command)(train.train)
app.command("list", cls=Command)(list_names.list_names)
app.add_typer(experiment.app, name="experiment")
app.add_typer(recordings.app, name="recordings")
app.add_typer(hardware.app, name="hardware")


def _version(value: bool) -> None:
    if value:
        from equimus_ctrl import __version__

        typer.echo(f"equimus-ctrl {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    pass


def main(arguments: list[str] | None = None) -> int:
    """Run the command with ``arguments`` (those of the process by default) and return its exit code."""
    warnings.showwarning = _show_warning  # type: ignore[assignment]
    told = logging.getLogger("equimus_ctrl")
    if not told.handlers:
        told.addHandler(_ToPeople())
        told.setLevel(logging.INFO)
    try:
        code = app(args=arguments, prog_name="equimus-ctrl", standalone_mode=False)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except TyperException as error:
        return _usage(error)
    except EquimusError as error:
        _say(str(error))
        return 3 if type(error).__name__ in ("NothingFeasible", "SimulationDiverged", "HardwareFault") else 2
    except OSError as error:  # a name too long, a loop of links, a full disk: of whatever path, whatever the verb
        _say(("" if error.filename is None else f"{error.filename}: ") + (error.strerror or str(error)))
        return 2
    except MemoryError as error:
        _say(f"there is not enough memory for what was given ({error or 'of this process'})")
        return 2
    except RuntimeError as error:
        if not str(error).startswith("Symlink loop"):  # pathlib's word for what the system calls an OSError
            raise
        _say(str(error))
        return 2
    return code if isinstance(code, int) else 0


def _say(sentence: str) -> None:
    print(f"equimus-ctrl: {one_line(sentence)}", file=sys.stderr)


def _usage(error: Any) -> int:
    """Tell of arguments that the command line does not have, or that are of the wrong type; its exit code."""
    if type(error).__name__ == "NoArgsIsHelpError":  # nothing was given at all: its message is the help
        print(error.format_message())
    else:
        context = getattr(error, "ctx", None)
        where = "equimus-ctrl" if context is None else context.command_path
        said = str(error.format_message()).strip().rstrip(".").replace("Value error, ", "")  # what Typer calls it
        _say(f"{said}; see {where} --help")
    return int(error.exit_code)


class _ToPeople(logging.Handler):
    """What takes its time is told on standard error, wherever that goes just then."""

    def emit(self, record: logging.LogRecord) -> None:
        """A line."""
        print(record.getMessage(), file=sys.stderr)


def _show_warning(message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: object) -> None:
    _say(f"warning: {message}")


def entry() -> None:
    """The console script."""
    keep_freed_memory()
    code = main()
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        print(f"equimus-ctrl: standard output cannot be written ({error.strerror or error})", file=sys.stderr)
        code = code or 2
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left there is not tried again
    sys.exit(code)
