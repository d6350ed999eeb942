"""Getting the full recordings of the leg from the public repository, each with a known hash."""

from __future__ import annotations

import hashlib
import http.client
import json
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from equimus_ctrl.errors import NotAvailable
from equimus_ctrl.recordings.locate import fetch_folder
from equimus_ctrl.recordings.sheet import PathLike, reason

REPOSITORY = "fly-pigTH/EquiMus"
FILES: Mapping[str, str] = {
    "ToCenter_2025-02-20_21-06-20_A2B_data.csv": "f8c22a04427f54da2ea9f80efa949a61960ba8f4561f0d156713909fbf53a9e5",
    "TriStatic_2025-01-21_19-26-44_A2B_data.csv": "357895605f00d58c45c198541772bc17551dce88cbb8536263afe9a77f0584ff",
}
"""SHA-256 of each file by its name; where in the repository it lies is asked at run time."""

API = "https://api.github.com"
RAW = "https://raw.githubusercontent.com"
_INSTEAD = "or name a folder that has the recordings with --recordings DIR or EQUIMUS_RECORDINGS"


@dataclass(frozen=True)
class Fetched:
    """One file that is now there.

    Attributes:
        path: where it is.
        downloaded: False where it was there already, with the right hash.
    """

    path: Path
    downloaded: bool


def fetch(
    output: PathLike | None = None,
    *,
    files: Mapping[str, str] = FILES,
    repository: str = REPOSITORY,
    branch: str = "HEAD",
    api: str = API,
    raw: str = RAW,
    timeout: float = 30.0,
) -> tuple[Fetched, ...]:
    """Download ``files`` into ``output``; those already there with the right hash are left as they are.

    The repository's tree is listed to learn where each file lies; it is then downloaded to a temporary file, and moved
    into place only if its hash is right. One that fails does not undo those before it, so the same call resumes.

    Args:
        output: folder to put the files in; ``fetch_folder()`` where None. It is made where it does not exist.
        files: SHA-256 of each file by its name.
        repository: ``owner/name``.
        branch: branch, tag or commit; the default branch where ``HEAD``.
        api: base URL of the service that lists the tree.
        raw: base URL of the service that gives the files.
        timeout: longest wait for an answer [s].

    Raises:
        NotAvailable: the network or the repository does not answer, a file is not in the tree, a hash is wrong, or the
            folder cannot be written.
    """
    import pooch

    pooch.get_logger().setLevel("ERROR")
    folder = fetch_folder() if output is None else Path(output)
    try:
        missing = {name for name, sha256 in files.items() if not _has(folder / name, sha256)}
        tree = _tree(f"{api}/repos/{repository}/git/trees/{branch}?recursive=1", timeout) if missing else []
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise NotAvailable(f"{folder}: the recordings cannot be stored there ({reason(error)})") from error
    for name in sorted(missing):
        path = _path_in(tree, name, repository)
        url = f"{raw}/{repository}/{branch}/{urllib.parse.quote(path)}"
        try:
            pooch.retrieve(url, f"sha256:{files[name]}", name, folder, downloader=pooch.HTTPDownloader(timeout=timeout))
        except ValueError as error:
            raise NotAvailable(
                f"{url}: what came is not the file expected (its SHA-256 is not {files[name]}), so it was thrown away; "
                f"try again later, {_INSTEAD}"
            ) from error
        except OSError as error:
            raise _no_answer(url, error) from error
    return tuple(Fetched(folder / name, name in missing) for name in files)


def _has(path: Path, sha256: str) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == sha256


def _tree(url: str, timeout: float) -> list[str]:
    """Paths of all files in the repository."""
    request = urllib.request.Request(
        url, headers={"Accept": "application/vnd.github+json", "User-Agent": "equimus-ctrl"}
    )
    try:
        with urllib.request.urlopen(request, timeout=timeout) as answer:
            listing: Any = json.load(answer)
        return [entry["path"] for entry in listing["tree"] if entry.get("type", "blob") == "blob"]
    except (OSError, http.client.HTTPException) as error:
        raise _no_answer(url, error) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise NotAvailable(
            f"{url}: the answer is not a listing of the repository; try again later, {_INSTEAD}"
        ) from error


def _path_in(tree: list[str], name: str, repository: str) -> str:
    for path in sorted(tree, key=len):
        if path.rpartition("/")[2] == name:
            return path
    raise NotAvailable(f"{name} is not in the repository {repository} (of {len(tree)} files there); {_INSTEAD[3:]}")


def _no_answer(url: str, error: Exception) -> NotAvailable:
    code = error.code if isinstance(error, urllib.error.HTTPError) else _status(error)
    if code:
        return NotAvailable(f"{url}: the server answered {code}; try again later, {_INSTEAD}")
    host = urllib.parse.urlsplit(url).netloc
    return NotAvailable(
        f"the recordings cannot be fetched, as {host} cannot be reached; go online and try again, {_INSTEAD}"
    )


def _status(error: Exception) -> int | None:
    """The HTTP status that the downloader's exception carries, if it carries one."""
    status = getattr(getattr(error, "response", None), "status_code", None)
    return status if isinstance(status, int) else None
