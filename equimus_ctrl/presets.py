"""Where the files a user edits are found and written: controllers/, hardware/, scenarios/, tuning/.

They are looked for in the current folder, then in the checkout the package runs from, then among the presets the
package carries. What is written goes to the current folder, or to the checkout when the command runs inside it.
"""

from __future__ import annotations

import ast
import errno
import importlib.util
import json
import logging
import math
import os
import stat
import sys
import tempfile
import tomllib
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import cloudpickle
import tomlkit

from equimus_ctrl.errors import FAILURES, ConfigError, ControllerError, EquimusError, ModelError, unknown_name

MJCF = (".xml", ".mjcf", ".urdf")
"""What files of robots that MuJoCo loads end with."""
KINDS = ("controllers", "hardware", "scenarios", "tuning")
_PACKAGE = Path(__file__).resolve().parent


def plain_name(name: str) -> str:
    """A name as part of a file's."""
    return "".join(ch if ch.isalnum() or ch in "-_" else "_" for ch in name)


def read_mjcf(path: Path) -> tuple[str, str, dict[str, bytes]]:
    """(name, text in one piece, files that it names) of an MJCF file, or of a URDF.

    Of a URDF what only shows and collides is left out, with its meshes.

    Raises:
        ConfigError: where there is no such file.
        ModelError: where MuJoCo cannot load it.
    """
    import mujoco  # takes a while, and few need it here

    from equimus_ctrl.quiet import quietly

    try:
        text = read_bytes(path).decode("utf-8")
        urdf = path.suffix.lower() == ".urdf"
        with quietly(), warnings.catch_warnings():  # what is wrong with an XML is told in a sentence
            warnings.filterwarnings("ignore", "Inertia matrix")
            spec = mujoco.MjSpec.from_string(_without_shapes(text)) if urdf else mujoco.MjSpec.from_file(str(path))
            spec.compile()
        # MuJoCo writes numbers to six digits; what includes other files cannot stay as it is.
        xml = spec.to_xml() if urdf or "<include" in text else text
    except (ValueError, mujoco.FatalError, ElementTree.ParseError) as error:
        raise ModelError(f"{path}: MuJoCo cannot load it ({' '.join(str(error).split())})") from None
    assets = {name: data if isinstance(data, bytes) else str(data).encode() for name, data in spec.assets.items()}
    for parts, folder in ((spec.meshes, spec.meshdir), (spec.hfields, spec.meshdir), (spec.textures, spec.texturedir)):
        for name in (part.file for part in parts):
            for place in (path.parent / folder / name, path.parent / name):  # where MuJoCo looks comes first
                if name and name not in assets and place.is_file():
                    assets[name] = place.read_bytes()
    name = spec.modelname
    return (path.stem if name in ("", "MuJoCo Model") else name), xml, assets


def _without_shapes(text: str) -> str:
    """A URDF without what only shows and collides: no equation of motion needs it, and meshes may be anywhere."""
    root = ElementTree.fromstring(text)
    for link in root.iter("link"):
        for part in [child for child in link if child.tag in ("visual", "collision")]:
            link.remove(part)
    return ElementTree.tostring(root, encoding="unicode")


def checkout() -> Path | None:
    """The checkout this package runs from, or None where it is installed."""
    root = _PACKAGE.parent
    return root if (root / "pyproject.toml").is_file() and (root / "scenarios").is_dir() else None


def roots() -> list[Path]:
    """Folders that are searched, the first first."""
    found = [Path.cwd()]
    if (here := checkout()) is not None:
        found.append(here)
    found.append(_PACKAGE / "_presets")
    return list(dict.fromkeys(found))


def workspace() -> Path:
    """Where results and settings are written: the checkout when inside it, else the current folder."""
    here = checkout()
    cwd = Path.cwd()
    return here if here is not None and (cwd == here or here in cwd.parents) else cwd


def shown(path: Path) -> str:
    """A path as people would write it from here: a preset by its kind and name, whichever folder it was found in."""
    whole = path.resolve()
    inside = [whole.relative_to(root) for root in (own.resolve() for own in roots()) if whole.is_relative_to(root)]
    return min((own.as_posix() for own in inside), key=len, default=str(path))


def find(kind: str, file: str) -> Path | None:
    """The first file of that name under ``kind`` in the folders searched."""
    return next((path for root in roots() if (path := root / kind / file).is_file()), None)


def names(kind: str, suffix: str) -> dict[str, Path]:
    """Stem → path of all presets of a kind, those found first winning."""
    found: dict[str, Path] = {}
    for root in roots():
        for path in sorted((root / kind).glob(f"*{suffix}")):
            if not path.name.startswith("_"):
                found.setdefault(path.stem, path)
    return found


def read_toml(path: Path) -> dict[str, Any]:
    """What a TOML file holds.

    Raises:
        ConfigError: where it cannot be read or is not TOML.
    """
    try:
        data = tomllib.loads(read_bytes(path).decode("utf-8").replace("\r\n", "\n"))
        _check_integers(data, path)
        return data
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from None
    except RecursionError:
        raise ConfigError(f"{path}: is nested too deeply to be read") from None
    except ValueError as error:  # TOMLDecodeError, or an integer of more digits than Python reads
        raise ConfigError(f"{path}: is not valid TOML: {error}") from None


LARGEST_INTEGER = 2**63 - 1
"""Of TOML."""


def _check_integers(value: Any, path: Path, name: str = "") -> None:
    """Raise ConfigError for an integer that TOML does not have: no floating-point number may be as large."""
    if isinstance(value, dict):
        for key, own in value.items():
            _check_integers(own, path, f"{name}.{key}" if name else key)
    elif isinstance(value, list):
        for own in value:
            _check_integers(own, path, name)
    elif isinstance(value, int) and not -LARGEST_INTEGER - 1 <= value <= LARGEST_INTEGER:
        raise ConfigError(f"{path}: {name} is {value}, expected an integer of at most 64 bits")


def relative(path: Path, folder: Path) -> str:
    """A path as a file in a folder names it."""
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def read_bytes(path: Path) -> bytes:
    """What a file holds.

    Raises:
        ConfigError: where it cannot be read.
    """
    try:
        check_regular(path)
        return path.read_bytes()
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from None


def check_regular(path: Path) -> None:
    """Raise OSError where a path is no file with an end: a pipe or a device may never come to one."""
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "it is a pipe or a device, expected a file")


def toml_text(data: Mapping[str, Any], comment: str = "") -> str:
    """TOML text of nested tables, after comment lines."""
    document = tomlkit.document()
    for line in comment.splitlines():
        document.add(tomlkit.comment(line) if line else tomlkit.nl())
    if comment:
        document.add(tomlkit.nl())
    for key, value in data.items():
        document.add(key, tomlkit.item(value))
    return tomlkit.dumps(document)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file whole or not at all: to a temporary file beside it, then renamed.

    Raises:
        ConfigError: where it cannot be written there.
    """
    check_place(path)  # renaming would take the place of a device
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as out:
            try:
                out.write(data)
                out.flush()
                os.chmod(out.name, 0o644)
                os.replace(out.name, path)
            except BaseException:
                Path(out.name).unlink(missing_ok=True)
                raise
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from None


def check_folder(path: Path) -> None:
    """Raise ConfigError where nothing can be put into a folder: a file is in its place, or it may not be written to."""
    try:
        there = next((p for p in (path, *path.parents) if p.exists()), None)
    except OSError as error:  # a name too long, or a loop of links
        raise ConfigError(f"{path}: is no folder and cannot become one ({error.strerror or error})") from None
    if there is not None and not there.is_dir():
        raise ConfigError(f"{path}: is no folder and cannot become one ({there} is a file)")
    if there is None:
        return
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"{path}: nothing can be written there ({there} may not be written to)")
    try:
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        raise ConfigError(f"{path}: nothing can be written there ({there}: {error.strerror or error})") from None


def check_toml(path: Path) -> None:
    """Raise ConfigError where a TOML file cannot be written, or would take the place of some other kind of file."""
    _check_file(path, ".toml", "TOML")


def check_xml(path: Path) -> None:
    """The same of an XML file."""
    _check_file(path, ".xml", "XML")


def check_png(path: Path) -> None:
    """The same of a picture."""
    _check_file(path, ".png", "PNG")


def _check_file(path: Path, suffix: str, what: str) -> None:
    check_place(path)
    if path.suffix.lower() != suffix:
        raise ConfigError(f"{path}: what is written there is {what}; expected a name that ends in {suffix}")


def check_place(path: Path) -> None:
    """Raise ConfigError where no file can be written: nothing can be put into its folder, or what is there is none."""
    try:
        check_folder(path.parent)
        there = path.stat() if os.path.lexists(path) else None
    except ConfigError as error:
        raise ConfigError(f"{path}: cannot be written; {error}") from None
    except FileNotFoundError:  # a link to nowhere is replaced as a file is
        return
    except OSError as error:  # a loop of links, or a name too long
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from None
    if there is not None and stat.S_ISDIR(there.st_mode):
        raise ConfigError(f"{path}: is a folder; a file to write belongs there")
    if there is not None and not stat.S_ISREG(there.st_mode):
        raise ConfigError(f"{path}: is a pipe or a device; a file to write belongs there")


def make_folder(path: Path) -> None:
    """Make a folder and those above it.

    Raises:
        ConfigError: where that cannot be.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{path}: is no folder and cannot become one ({error.strerror or error})") from None


def write_text(path: Path, text: str) -> None:
    """``write_bytes`` of UTF-8 text."""
    write_bytes(path, text.encode())


def load_script(path: Path, *, sent: bool = True) -> ModuleType:
    """Run a user's Python file as a module.

    Args:
        path: of the file.
        sent: whether what it defines is sent to other processes that need it; else they load the file themselves.

    Raises:
        ConfigError: where it cannot be read or fails.
    """
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such file")
    name = f"equimus_user_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigError(f"{path}: is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    if sent:
        cloudpickle.register_pickle_by_value(module)
    elif name in cloudpickle.list_registry_pickle_by_value():
        cloudpickle.unregister_pickle_by_value(module)
    try:
        spec.loader.exec_module(module)
    except EquimusError as error:
        raise type(error)(f"{path}: {error}") from error
    except FAILURES as error:
        raise ConfigError(f"{path}: fails when it is loaded: {type(error).__name__}: {error}") from error
    return module


def described_function(path: Path, name: str) -> tuple[str, dict[str, Any], bool]:
    """What a Python file says of itself and of one of its functions, without running it.

    Returns:
        The first paragraph of its docstring as one line, each of the function's parameters with its default (None
        without one, its text where it has to be computed), and whether it takes any others; nothing of a function that
        the file has from elsewhere.

    Raises:
        ConfigError: where it cannot be read or is no Python.
    """
    try:
        tree = ast.parse(read_bytes(path), str(path))
    except (SyntaxError, ValueError, RecursionError) as error:
        raise ConfigError(f"{shown(path)}: is no Python file ({error})") from None
    summary = (ast.get_docstring(tree) or "").partition("\n\n")[0].replace("\n", " ")
    found = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == name]
    if not found:  # it may come from elsewhere, which is not known before it is run
        return summary, {}, False
    known: dict[str, ast.expr] = {}
    for node in tree.body:
        if isinstance(node, ast.Assign):
            for target in node.targets:
                known |= _named(target, node.value)
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            known |= _named(node.target, node.value)
    given = found[-1].args
    names = [*given.posonlyargs, *given.args]
    usual = [*[None] * (len(names) - len(given.defaults)), *given.defaults]
    pairs = [*zip(names, usual, strict=True), *zip(given.kwonlyargs, given.kw_defaults, strict=True)]
    options = {arg.arg: _literal(default, known) for arg, default in pairs}
    return summary, options, given.kwarg is not None


def _named(target: ast.expr, value: ast.expr) -> dict[str, ast.expr]:
    """What an assignment gives names to, of tuples on both sides each of theirs."""
    if isinstance(target, ast.Name):
        return {target.id: value}
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) and len(target.elts) == len(value.elts):
        pairs = [_named(*pair) for pair in zip(target.elts, value.elts, strict=True)]
        return {name: own for pair in pairs for name, own in pair.items()}
    return {}


def _literal(node: ast.expr | None, known: Mapping[str, ast.expr]) -> Any:
    """A default's value, also where the file names it; its text where it has to be computed."""
    if node is None:
        return None
    try:
        return ast.literal_eval(known.get(node.id, node) if isinstance(node, ast.Name) else node)
    except (ValueError, TypeError, MemoryError, RecursionError):
        return ast.unparse(node)


def load_scenario(name: str, others: Iterable[str] = ()) -> tuple[Callable[..., Any], str]:
    """The ``build`` function of a scenario script by name or path, and where it was found.

    Args:
        name: of a script, or a path to one.
        others: scenarios that are known without a script, for messages.

    Raises:
        ConfigError: where there is no such scenario or it has no ``build``.
    """
    known = names("scenarios", ".py")
    path = Path(name) if name.endswith(".py") else known.get(name)
    if path is None:
        raise ConfigError(unknown_name("scenario", name, {*known, *others}))
    module = load_script(path)
    build = getattr(module, "build", None)
    if not callable(build):
        raise ConfigError(f"{shown(path)}: has no function build(context, …) that returns a Scenario")
    return build, shown(path)


def load_object(text: str) -> Any:
    """What ``path/to/file.py:Name`` names.

    Raises:
        ControllerError: where the text is not of that form or the file has no such name.
        ConfigError: where the file cannot be loaded.
    """
    file, colon, name = text.rpartition(":")
    if not colon or not file.endswith(".py") or not name.isidentifier():
        raise ControllerError(
            f"{text!r} is neither a known controller nor path/to/file.py:Name nor a policy.zip or policy.onnx"
        )
    module = load_script(Path(file))
    if not hasattr(module, name):
        public = [key for key in vars(module) if not key.startswith("_")]
        raise ControllerError(unknown_name("name", name, public, file))
    return getattr(module, name)


class JsonLines:
    """An append-only file of JSON rows under a header that says what they belong to.

    A row is on disk as soon as it is appended, so a killed process loses none; a last row cut short is dropped when
    the file is opened again. A file with another header is set aside, not overwritten.

    Args:
        path: of the file.
        header: must equal the file's first row for its rows to be taken up.
        fresh: set an existing file aside whatever its header.
    """

    def __init__(self, path: Path, header: Mapping[str, Any], fresh: bool = False) -> None:
        self.path = path
        self.rows: list[dict[str, Any]] = []
        self._lost = False
        make_folder(path.parent)
        if path.exists():
            found = self._read()
            if not fresh and found and found[0] == dict(header):
                self.rows = found[1:]
            else:
                os.replace(path, self._aside())
        # Written anew so that a cut last row is gone before the next is appended.
        write_text(path, "".join(json.dumps(row) + "\n" for row in [dict(header), *self.rows]))
        self._file = path.open("a", encoding="utf-8")

    @staticmethod
    def header_of(path: Path) -> dict[str, Any] | None:
        """The first row of a file; None where there is no file, or no row to be read."""
        try:
            with path.open(encoding="utf-8", errors="replace") as file:
                found = json.loads(file.readline())
        except (OSError, json.JSONDecodeError):
            return None
        return found if isinstance(found, dict) else None

    def append(self, row: Mapping[str, Any]) -> None:
        """Add a row and hand it to the operating system; where that cannot be, the work goes on without the file."""
        self.rows.append(dict(row))
        if self._lost:
            return
        try:
            self._file.write(json.dumps(row) + "\n")
            self._file.flush()
        except OSError as error:
            self._lost = True
            logging.getLogger("equimus_ctrl").warning(
                "%s: cannot be written any more (%s); what is found from here on is not kept for another run",
                self.path, error.strerror or error,
            )  # fmt: skip

    def truncate(self, count: int) -> None:
        """Drop all rows from number ``count`` on, from the file too."""
        header = json.loads(self.path.read_text(encoding="utf-8").partition("\n")[0])
        self.close()
        del self.rows[count:]
        write_text(self.path, "".join(json.dumps(row) + "\n" for row in [header, *self.rows]))
        self._file, self._lost = self.path.open("a", encoding="utf-8"), False

    def close(self) -> None:
        """Close the file; what a full disk left in its buffer is lost."""
        with suppress(OSError):
            self._file.close()

    def _read(self) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        for line in self.path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                row = json.loads(line)
            except json.JSONDecodeError:
                break
            if not isinstance(row, dict):
                break
            rows.append(row)
        return rows

    def _aside(self) -> Path:
        k = 1
        while (other := self.path.with_name(f"{self.path.stem}-{k}{self.path.suffix}")).exists():
            k += 1
        return other


def plain(value: Any) -> Any:
    """``value`` with tuples as lists and numbers that JSON does not have (NaN, infinity) as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def json_text(value: Any) -> str:
    """Indented JSON of plain types."""
    return json.dumps(plain(value), indent=1, allow_nan=False) + "\n"
