"""Fetching from a server on this machine that imitates the two that are asked, and finding what is there."""

from __future__ import annotations

import hashlib
import json
import os
import re
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from equimus_ctrl.errors import NotAvailable, RecordingError
from equimus_ctrl.recordings import fetch, fetch_folder, find_recordings, leg_file, locate, missing_hint
from equimus_ctrl.recordings.download import FILES

CONTENT = {"one.csv": b"a,b\n1,2\n", "two.csv": b"c\n3\n"}
HASHES = {name: hashlib.sha256(content).hexdigest() for name, content in CONTENT.items()}


class Hub:
    """What the server gives: bytes by path, 404 elsewhere; and what it was asked for."""

    def __init__(self) -> None:
        self.answers: dict[str, bytes] = {}
        self.asked: list[str] = []
        self.url = ""

    def offer(self, places: dict[str, str]) -> None:
        """List ``places`` (path by file name) as the tree, and serve the files there."""
        tree = [{"path": "data", "type": "tree"}, *({"path": path, "type": "blob"} for path in places.values())]
        self.answers["/repos/who/what/git/trees/HEAD?recursive=1"] = json.dumps({"tree": tree}).encode()
        for name, path in places.items():
            self.answers[f"/who/what/HEAD/{path.replace(' ', '%20')}"] = CONTENT[name]

    def fetch(self, output: Path, **options: Any) -> tuple[tuple[str, bool], ...]:
        defaults: dict[str, Any] = {
            "files": HASHES,
            "repository": "who/what",
            "api": self.url,
            "raw": self.url,
            "timeout": 5.0,
        }
        return tuple((file.path.name, file.downloaded) for file in fetch(output, **(defaults | options)))


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    for variable in ("http_proxy", "https_proxy", "all_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"):
        monkeypatch.delenv(variable, raising=False)
    hub = Hub()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            hub.asked.append(self.path)
            answer = hub.answers.get(self.path)
            self.send_response(404 if answer is None else 200)
            self.send_header("Content-Length", str(len(answer or b"")))
            self.end_headers()
            self.wfile.write(answer or b"")

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    hub.url = f"http://127.0.0.1:{server.server_port}"
    hub.offer({"one.csv": "data/real leg/one.csv", "two.csv": "two.csv"})
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield hub
    server.shutdown()
    server.server_close()
    thread.join()


def test_fetches_from_wherever_the_files_lie(hub: Hub, tmp_path: Path) -> None:
    assert hub.fetch(tmp_path / "new" / "folder") == (("one.csv", True), ("two.csv", True))
    for name, content in CONTENT.items():
        assert (tmp_path / "new" / "folder" / name).read_bytes() == content
    assert sorted(os.listdir(tmp_path / "new" / "folder")) == ["one.csv", "two.csv"]


def test_what_is_there_is_not_fetched_again(hub: Hub, tmp_path: Path) -> None:
    (tmp_path / "one.csv").write_bytes(CONTENT["one.csv"])
    assert hub.fetch(tmp_path) == (("one.csv", False), ("two.csv", True))
    asked = len(hub.asked)
    assert hub.fetch(tmp_path) == (("one.csv", False), ("two.csv", False))
    assert len(hub.asked) == asked


def test_a_file_with_another_hash_is_replaced(hub: Hub, tmp_path: Path) -> None:
    (tmp_path / "one.csv").write_bytes(b"half of i")
    assert hub.fetch(tmp_path)[0] == ("one.csv", True)
    assert (tmp_path / "one.csv").read_bytes() == CONTENT["one.csv"]


def test_a_wrong_hash_is_thrown_away(hub: Hub, tmp_path: Path) -> None:
    hub.answers["/who/what/HEAD/two.csv"] = b"something else"
    with pytest.raises(NotAvailable, match=r"two\.csv: what came is not the file expected \(its SHA-256 is not"):
        hub.fetch(tmp_path)
    assert os.listdir(tmp_path) == ["one.csv"]
    hub.answers["/who/what/HEAD/two.csv"] = CONTENT["two.csv"]
    assert hub.fetch(tmp_path) == (("one.csv", False), ("two.csv", True))


def test_a_file_that_is_not_there(hub: Hub, tmp_path: Path) -> None:
    del hub.answers["/who/what/HEAD/two.csv"]
    with pytest.raises(NotAvailable, match=r"two\.csv: the server answered 404; try again later, or name a folder"):
        hub.fetch(tmp_path)
    hub.offer({"one.csv": "one.csv"})
    with pytest.raises(NotAvailable, match=r"two\.csv is not in the repository who/what \(of 1 files there\); name a"):
        hub.fetch(tmp_path)


def test_a_repository_that_is_not_there(hub: Hub, tmp_path: Path) -> None:
    with pytest.raises(NotAvailable, match=r"/git/trees/gone\?recursive=1: the server answered 404"):
        hub.fetch(tmp_path / "new", branch="gone")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("answer", [b"<html>", b"[]", b'{"tree": 1}', b'{"tree": [{}]}', b'{"tree": [1]}', b"\xff"])
def test_a_listing_that_is_none(hub: Hub, tmp_path: Path, answer: bytes) -> None:
    hub.answers["/repos/who/what/git/trees/HEAD?recursive=1"] = answer
    with pytest.raises(NotAvailable, match="the answer is not a listing of the repository"):
        hub.fetch(tmp_path)


def test_offline(hub: Hub, tmp_path: Path) -> None:
    refused = "http://127.0.0.1:9"
    sentence = (
        "the recordings cannot be fetched, as 127.0.0.1:9 cannot be reached; go online and try again, or name a folder "
        "that has the recordings with --recordings DIR or EQUIMUS_RECORDINGS"
    )
    for options in ({"api": refused, "raw": refused}, {"raw": refused}):
        with pytest.raises(NotAvailable, match=f"^{re.escape(sentence)}$"):
            hub.fetch(tmp_path, **options)
    assert os.listdir(tmp_path) == []


def test_a_folder_that_cannot_be_written(hub: Hub, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(NotAvailable, match=r"file: the recordings cannot be stored there \(File exists\)"):
        hub.fetch(tmp_path / "file")


def test_the_known_hashes() -> None:
    assert [sha256[:8] for sha256 in FILES.values()] == ["f8c22a04", "35789560"]
    assert all(len(sha256) == 64 for sha256 in FILES.values())


# --- finding ---


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A place from which no recordings are to be seen, with folders ``cwd`` and ``home``."""
    monkeypatch.delenv("EQUIMUS_RECORDINGS", raising=False)
    monkeypatch.setattr(
        locate, "__file__", str(tmp_path / "away" / "checkout" / "package" / "recordings" / "locate.py")
    )
    monkeypatch.setattr(locate, "fetch_folder", lambda: tmp_path / "home")
    (tmp_path / "cwd").mkdir()
    monkeypatch.chdir(tmp_path / "cwd")
    return tmp_path


def filled(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "a.csv").touch()
    return folder


def test_recordings_are_looked_for_in_order(nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert find_recordings() is None
    (nowhere / "home").mkdir()
    assert find_recordings() is None
    (nowhere / "home" / "a.csv").touch()
    assert find_recordings() == nowhere / "home"
    by_checkout = filled(nowhere / "away" / "shared" / "recordings")
    assert find_recordings() == by_checkout
    by_cwd = filled(nowhere / "shared" / "recordings")
    assert find_recordings() == by_cwd
    by_variable = filled(nowhere / "variable")
    monkeypatch.setenv("EQUIMUS_RECORDINGS", str(by_variable))
    assert find_recordings() == by_variable
    explicit = filled(nowhere / "explicit")
    assert find_recordings(explicit) == explicit
    monkeypatch.setenv("EQUIMUS_RECORDINGS", "")
    assert find_recordings() == by_cwd


def test_a_named_folder_must_be_there(nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        RecordingError, match="^--recordings: .*gone does not exist; a folder of recordings belongs there"
    ):
        find_recordings(nowhere / "gone")
    monkeypatch.setenv("EQUIMUS_RECORDINGS", str(filled(nowhere / "variable") / "a.csv"))
    with pytest.raises(RecordingError, match=r"^EQUIMUS_RECORDINGS: .*a\.csv is not a folder"):
        find_recordings()
    with pytest.raises(RecordingError, match="EQUIMUS_RECORDINGS"):
        leg_file("triangle")


def test_leg_files_by_name_and_by_columns(nowhere: Path) -> None:
    folder = nowhere / "explicit"
    (folder / "equimus_leg").mkdir(parents=True)
    assert leg_file("triangle", folder) is None
    (folder / "equimus_leg" / "static_poses_13.csv").touch()
    assert leg_file("static_poses_13", folder) == folder / "equimus_leg" / "static_poses_13.csv"
    assert leg_file("static_poses_36", folder) is None
    step, triangle = folder / "TriStatic_x_A2B_data.csv", folder / "ToCenter_x_A2B_data.csv"
    step.write_text("relative_time,current_pressure1\n")
    triangle.write_text("relative_time,pressure1_end\n")
    (folder / "Empty_A2B_data.csv").touch()
    (folder / "Spoilt_A2B_data.csv").write_bytes(b"\xff")
    assert leg_file("step_release", folder) == step and leg_file("triangle", folder) == triangle
    (folder / "triangle.csv").touch()
    assert leg_file("triangle", folder) == folder / "triangle.csv"


def test_leg_files_are_looked_for_in_every_place(nowhere: Path) -> None:
    filled(nowhere / "shared" / "recordings")
    filled(nowhere / "home")
    (nowhere / "home" / "triangle.csv").touch()
    assert leg_file("triangle") == nowhere / "home" / "triangle.csv"
    assert leg_file("triangle", nowhere / "shared" / "recordings") is None


def test_an_unknown_kind_is_refused(nowhere: Path) -> None:
    with pytest.raises(RecordingError, match="there is no kind of leg recording 'triangel'; did you mean 'triangle'"):
        leg_file("triangel")  # type: ignore[arg-type]


def test_the_real_files_are_found(leg_dir: Path) -> None:
    assert leg_file("triangle", leg_dir) == leg_dir / "triangle.csv"
    assert leg_file("static_poses_36", leg_dir.parent) == leg_dir / "static_poses_36.csv"


def test_the_hint_says_both_ways() -> None:
    hint = missing_hint()
    assert "equimus-ctrl recordings fetch" in hint and "--recordings DIR" in hint and "EQUIMUS_RECORDINGS" in hint


def test_the_fetch_folder_is_the_users_own() -> None:
    assert fetch_folder().is_absolute() and fetch_folder().parts[-2:] == ("equimus_ctrl", "recordings")
