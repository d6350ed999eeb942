"""A run in MuJoCo's viewer: where the robot and its ghost are, what drives them, and that the page is served."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from equimus_ctrl import workflow
from equimus_ctrl.cli.main import main
from equimus_ctrl.errors import ConfigError, NotAvailable
from equimus_ctrl.report import video, viewing
from equimus_ctrl.report.viewing import GHOST, check_viewer, put, shown_of, view
from equimus_ctrl.types import Recording

PENDULUM = Path(__file__).resolve().parents[1] / "docs" / "examples" / "pendulum.xml"


def angles(shown: viewing.Shown, k: int, names: tuple[str, ...], prefix: str = "") -> Any:
    return [shown.qpos[k, shown.model.joint(prefix + name).qposadr[0]] for name in names]


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["leg", "pendulum"])
def test_the_robot_goes_as_it_went_and_the_ghost_as_was_recorded(robot: str) -> None:
    scenario, model = ("hold", None) if robot == "leg" else ("step", workflow.load_model(PENDULUM))
    done = workflow.run_scenario(scenario, "pid", model=model, options={"duration": "2"})
    run, spec = done.run, done.run.spec
    other = Recording("real", run.time, run.command, run.position + 0.1, spec.actuators, spec.joints)
    for recorded, beside, what in (
        (None, run.reference, "the reference"),
        (other, other.position, "the recording real"),
    ):
        shown = shown_of(run, done.model, recorded)
        assert shown.ghost == what and len(shown.qpos) == len(shown.time)
        for k in (0, len(shown.time) // 2, len(shown.time) - 1):
            for prefix, values in (("", run.position), (GHOST, beside)):
                wanted = [np.interp(shown.time[k], run.time, own) for own in values.T]
                np.testing.assert_allclose(angles(shown, k, spec.joints, prefix), wanted, atol=1e-6)
        faded = [shown.model.geom(g).name.startswith(GHOST) for g in range(shown.model.ngeom)]
        seen = {bool(shown.model.geom_rgba[g][3] < 0.5) for g in range(shown.model.ngeom)}
        assert seen == {True, False} and (not any(faded) or len(faded) % 2 == 0)


@pytest.mark.slow
def test_the_ends_of_elastic_actuators_meet_in_robot_and_ghost() -> None:
    done = workflow.run_scenario("hold", "pid", options={"duration": "1"})
    shown = shown_of(done.run, done.model)
    data = mujoco.MjData(shown.model)
    put(shown, data, 0.5)
    mujoco.mj_forward(shown.model, data)
    assert shown.model.neq and np.abs(data.efc_pos[data.efc_type == 0]).max() < 1e-6


@pytest.fixture
def short() -> viewing.Shown:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="a"/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    return viewing.Shown(model, np.arange(60) / viewing.FPS, np.arange(60.0)[:, None], "nothing")


def test_the_run_begins_anew_at_its_end(short: viewing.Shown) -> None:
    data = mujoco.MjData(short.model)
    for at, row in ((0.0, 0), (0.5001, 30), (0.9999, 59), (1.0001, 0), (7.2501, 15)):
        put(short, data, at)
        assert data.qpos[0] == row and data.time == pytest.approx(row / viewing.FPS) and data.qvel[0] == 0


def test_the_viewer_sets_pause_and_speed(short: viewing.Shown) -> None:
    plugin = pytest.importorskip("equimus_ctrl.report.viewer_plugin")
    from mujoco.studio import messages, sim

    seen: list[float] = []
    own = plugin.Playback(lambda data, at: seen.append(at))
    event = messages.StepEvent(model=short.model, data=mujoco.MjData(short.model))
    own.step_control.set_speed(50.0)
    begun = time.perf_counter()
    while len(seen) < 20:
        own._on_step(event)
    assert seen == sorted(seen) and seen[-1] == pytest.approx(0.5 * (time.perf_counter() - begun), rel=0.3)
    own.step_control.set_pause_state(sim.PauseState.NORMAL_PAUSED)
    own._on_step(event)
    assert len(seen) == 20


def test_without_the_viewer_or_a_window_a_sentence_says_so(
    monkeypatch: pytest.MonkeyPatch, short: viewing.Shown
) -> None:
    launch = pytest.importorskip("mujoco.studio.launch_passive")

    def fails(*_: Any, **__: Any) -> None:
        raise RuntimeError("no window\nhere")

    monkeypatch.setattr(launch, "run", fails)
    with pytest.raises(NotAvailable, match=r"cannot be opened here \(no window.*--view-web"):
        view(short, "")
    monkeypatch.setitem(sys.modules, "mujoco.studio.launch_passive", None)
    monkeypatch.delattr("mujoco.studio.launch_passive")
    with pytest.raises(NotAvailable, match="pip install mujoco-studio=="):
        check_viewer()


def listening(port: int) -> set[str]:
    """Addresses at which somebody listens on a port, as Linux tells them."""
    found = set()
    for name, family in (("tcp", socket.AF_INET), ("tcp6", socket.AF_INET6)):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            place, state = line.split()[1], line.split()[3]
            address, _, own = place.partition(":")
            if int(own, 16) == port and state == "0A":
                words = (bytes.fromhex(address[k : k + 8])[::-1] for k in range(0, len(address), 8))
                found.add(socket.inet_ntop(family, b"".join(words)))
    return found


def test_a_page_is_bound_where_it_is_asked_for_or_not_at_all(monkeypatch: pytest.MonkeyPatch) -> None:
    page = pytest.importorskip("equimus_ctrl.report.viewer_page")

    class Viewer:
        """Binds as the real one does, with less about it."""

        def __init__(self) -> None:
            self._host = "::"
            self._http_sock = self.bound()
            self.started = False
            self._start_server()

        def bound(self) -> socket.socket:
            return page.web_viewer.web_server.bind_public_socket(self._host)

        def _start_server(self) -> None:
            self.started = True

    class Everywhere(Viewer):
        def bound(self) -> socket.socket:
            return page.web_viewer.web_server.bind_public_socket("0.0.0.0")

    monkeypatch.setattr(page.web_viewer, "WebViewer", Viewer)
    for asked, got in (("127.0.0.1", "127.0.0.1"), ("0.0.0.0", "0.0.0.0")):
        own = page._page_on(asked)()
        assert own.started and own._http_sock.getsockname()[0] == got
        own._http_sock.close()
    monkeypatch.setattr(page.web_viewer, "WebViewer", Everywhere)
    with pytest.raises(NotAvailable, match=r"on one interface alone \(it binds 0\.0\.0\.0\)"):
        page._page_on("127.0.0.1")()
    monkeypatch.setattr(page.web_viewer, "WebViewer", object)
    with pytest.raises(NotAvailable, match="starts its server in another way"):
        page._page_on("127.0.0.1")


def test_the_interface_of_the_page_is_looked_at_before_the_run(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert viewing.check_host("localhost") in ("127.0.0.1", "::1")
    with pytest.raises(ConfigError, match=r"--view-web-host is '192.0.2.1', which is no address of this computer"):
        viewing.check_host("192.0.2.1")
    command = ["run", "hold", "--controller", "pid", "-o", str(tmp_path / "out"), "--view-web-host", "0.0.0.0"]
    assert main(command) == 2 and "--view-web-host is for --view-web alone" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def served(address: str, patience: float = 30.0) -> bytes:
    """A page; the viewer tells its address before it listens there."""
    until = time.monotonic() + patience
    while True:
        try:
            with urllib.request.urlopen(address, timeout=30) as answer:
                assert answer.status == 200
                return bytes(answer.read())
        except urllib.error.URLError:
            if time.monotonic() > until:
                raise
            time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.flaky(reruns=2)  # the viewer's thread may miss that it is to end, seldom
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="who listens is read from /proc")
def test_the_page_is_served_and_ctrl_c_closes_it(tmp_path: Path) -> None:
    pytest.importorskip("mujoco.studio.launch_web")
    command = [sys.executable, "-m", "equimus_ctrl", "run", "hold", "--controller", "pid", "--set", "duration=1"]
    process = subprocess.Popen(
        [*command, "--no-figures", "-o", str(tmp_path / "out"), "--view-web", "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    said = ""
    try:
        assert process.stderr is not None
        while (port := re.search(r"http://localhost:(\d+)/", said)) is None:
            line = process.stderr.readline()
            assert line, said
            said += line
        assert b"<html" in served(f"http://localhost:{port[1]}/").lower()
        assert listening(int(port[1])) == {"127.0.0.1"}
        process.send_signal(signal.SIGINT)
        out, rest = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0 and "Traceback" not in said + rest
    assert "Remote:" not in said
    assert "the ghost is the reference" in said and out.startswith("{") and "Viewer" not in out


def test_a_video_is_looked_at_before_the_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert video.check_video(tmp_path / "a" / "film.gif") == ""
    monkeypatch.setattr(video, "find_ffmpeg", lambda: None)
    said = video.check_video(tmp_path / "film.mp4")
    assert "equimus-ctrl[video]" in said and said.endswith("film.gif") and "mp4" in said
    (tmp_path / "film.gif").write_bytes(b"")
    with pytest.raises(ConfigError, match="film.gif: is there already"):
        video.check_video(tmp_path / "film.mp4")
    assert video.check_video(tmp_path / "film.mp4", force=True)
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(ConfigError, match="is a folder"):
        video.check_video(tmp_path / "folder.mp4", force=True)
    with pytest.raises(NotAvailable, match="not as .avi"):
        video.check_video(tmp_path / "film.avi")


def test_a_recording_of_another_time_stands_still() -> None:
    """Before its first row and behind its last."""
    done = workflow.run_scenario("step", "pid", model=workflow.load_model(PENDULUM), options={"duration": "1.5"})
    spec = done.run.spec
    late = Recording("late", done.run.time + 60, done.run.command, done.run.position, spec.actuators, spec.joints)
    shown = shown_of(replace(done.run), done.model, late)
    first = done.run.position[0]
    np.testing.assert_allclose(angles(shown, len(shown.time) - 1, spec.joints, GHOST), first)
