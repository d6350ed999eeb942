"""Videos: what the frames hold, and what happens where something is not there."""

from __future__ import annotations

import stat
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from equimus_ctrl.errors import ConfigError, NotAvailable
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.plants.mujoco_plant import make_spec
from equimus_ctrl.report import film_frames, video
from equimus_ctrl.report.film import Film, Strip, make_film
from equimus_ctrl.report.film_frames import MujocoPictures, SketchPictures, gl_backends, write_scene
from equimus_ctrl.report.video import find_ffmpeg, save_video
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import Morphology
from equimus_ctrl.types import Run


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """No OpenGL."""
    monkeypatch.setenv("MUJOCO_GL", "off")


@pytest.fixture(scope="module")
def run() -> Run:
    """The thigh swings through 45° in half a second; the knee is bent; one pressure jumps at half time."""
    n = 60
    time = np.arange(n) / 120
    position = np.stack([np.linspace(np.pi / 4, np.pi / 2, n), np.full(n, 0.5)], axis=1)
    command = np.where(time[:, None] < 0.25, [0.0, 25e3], [50e3, 25e3])
    spec = make_spec(nominal_leg(), 1 / 120, None)
    still = np.tile([np.pi / 2, 0.5], (n, 1))
    return Run(spec, time, position, still, command, command, np.zeros((n, 2), bool), np.zeros(n), np.zeros(2))


@pytest.fixture(scope="module")
def rendered(run: Run) -> list[np.ndarray]:
    """All pictures of a small film, rendered by MuJoCo."""
    try:
        pictures = MujocoPictures(make_film(run, nominal_model(), 8, 240, 200))
    except NotAvailable as error:
        pytest.skip(str(error))
    frames = list(pictures)
    pictures.close()
    return frames


def centre(picture: np.ndarray, film: Film) -> np.ndarray:
    """(2,) mean place of what is not white, as shares of width and height."""
    rows, columns = np.nonzero((picture < 200).any(axis=2))
    return np.array([columns.mean() / film.width, rows.mean() / film.height])


def gif(path: Path) -> tuple[list[np.ndarray], list[int]]:
    """Frames and how long each is shown [ms]."""
    frames, durations = [], []
    with Image.open(path) as image:
        for k in range(image.n_frames):  # type: ignore[attr-defined]
            image.seek(k)
            frames.append(np.asarray(image.convert("RGB")))
            durations.append(image.info["duration"])
    return frames, durations


def test_a_film_lasts_as_long_as_the_run_and_holds_commands(run: Run) -> None:
    film = make_film(run, nominal_model(), 20, 240, 200)
    np.testing.assert_allclose(film.time, np.arange(10) / 20)
    np.testing.assert_allclose(film.position[1], [np.interp(0.05, run.time, c) for c in run.position.T])
    assert film.command[:, 0].tolist() == [0.0] * 5 + [50e3] * 5
    assert film.fill[-1].tolist() == [1.0, 0.5]
    low, high = film.box
    for points in (film.bones.points, film.traced, film.target):
        assert np.all(points >= low - 1e-12)
        assert np.all(points <= high + 1e-12)


def test_the_strip_shows_pressures_as_bars(run: Run) -> None:
    film = make_film(run, nominal_model(), 20, 720, 100)
    strip = Strip(film)
    blank = np.full((100, 720, 3), 255, np.uint8)
    early, late = strip.under(blank, 0), strip.under(blank, 9)
    assert early.shape == (100 + strip.height, 720, 3)
    orange, blue = (230, 159, 0), (86, 180, 233)
    assert not (early == orange).all(axis=2).any()
    full = (late == orange).all(axis=2).any(axis=0).sum()
    half = (late == blue).all(axis=2).any(axis=0).sum()
    assert half == pytest.approx(full / 2, abs=2)


def test_a_gif_is_drawn_where_opengl_is_forbidden(run: Run, tmp_path: Path, drawn: None) -> None:
    shares: list[float] = []
    result = save_video(run, nominal_model(), tmp_path / "a" / "leg.gif", fps=10, progress=shares.append)
    assert result.path == tmp_path / "a" / "leg.gif"
    assert result.renderer == "matplotlib"
    assert result.note == "MuJoCo cannot render here (MUJOCO_GL is 'off'), so the leg is drawn as lines"
    assert shares == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    frames, durations = gif(result.path)
    assert (len(frames), sum(durations)) == (5, 500)
    assert list((tmp_path / "a").iterdir()) == [result.path]
    film = make_film(run, nominal_model(), 10, *video.GIF_SIZE)
    moved = centre(frames[-1][: film.height], film) - centre(frames[0][: film.height], film)
    assert moved[0] < -0.05  # from the front to hanging down, where the bent knee points back


def test_without_ffmpeg_an_mp4_becomes_a_gif(
    run: Run, tmp_path: Path, drawn: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video, "find_ffmpeg", lambda: None)
    result = save_video(run, nominal_model(), tmp_path / "leg.mp4", fps=4)
    assert result.path == tmp_path / "leg.gif"
    assert result.note.startswith("there is no ffmpeg for mp4")
    assert [path.name for path in tmp_path.iterdir()] == ["leg.gif"]


def test_an_ffmpeg_that_fails_is_named_and_a_gif_written(
    run: Run, tmp_path: Path, drawn: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = tmp_path / "ffmpeg"
    broken.write_text("#!/bin/sh\necho 'Unknown encoder libx264' >&2\nexit 1\n")
    broken.chmod(broken.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(video, "find_ffmpeg", lambda: str(broken))
    result = save_video(run, nominal_model(), tmp_path / "out" / "leg.mp4", fps=4)
    assert result.path.name == "leg.gif"
    assert "ffmpeg could not write an mp4 (Unknown encoder libx264)" in result.note
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["leg.gif"]


def test_ffmpeg_gets_every_frame_at_the_asked_rate(
    run: Run, tmp_path: Path, drawn: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = tmp_path / "ffmpeg"
    fake.write_text('#!/bin/sh\necho "$@" > "$0.args"\nfor last; do :; done\ncat > "$last"\n')
    fake.chmod(fake.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(video, "find_ffmpeg", lambda: str(fake))
    result = save_video(run, nominal_model(), tmp_path / "leg.mp4", fps=4)
    arguments = (tmp_path / "ffmpeg.args").read_text()
    width, height = (int(side) for side in arguments.split("-s ")[1].split()[0].split("x"))
    assert width % 2 == height % 2 == 0
    assert "-r 4 " in arguments
    assert result.path.stat().st_size == 2 * width * height * 3


def test_a_real_mp4_where_there_is_an_ffmpeg(run: Run, tmp_path: Path, drawn: None) -> None:
    if find_ffmpeg() is None:
        pytest.skip("no ffmpeg here")
    result = save_video(run, nominal_model(), tmp_path / "leg.mp4", fps=10)
    assert result.path.suffix == ".mp4"
    assert result.path.read_bytes()[4:8] == b"ftyp"


@pytest.mark.parametrize(("name", "said"), [("leg.avi", "not as .avi"), ("leg", "not as a file without ending")])
def test_another_ending_is_refused(run: Run, tmp_path: Path, name: str, said: str) -> None:
    with pytest.raises(NotAvailable, match=said):
        save_video(run, nominal_model(), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_is_refused(run: Run, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="frame rate is 0 a second, expected 1 to 120"):
        save_video(run, nominal_model(), tmp_path / "leg.gif", fps=0)
    leg = nominal_leg()
    other = Morphology("other", leg.links, leg.joints, leg.actuators[:1], leg.foot)
    with pytest.raises(ConfigError, match="other has hip, knee and maa"):
        save_video(run, Model(other), tmp_path / "leg.gif")


def test_the_users_backend_is_tried_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film_frames.sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    for value, expected in (("", ["egl", "osmesa"]), ("osmesa", ["osmesa", "egl"]), ("Disabled", [])):
        monkeypatch.setenv("MUJOCO_GL", value)
        assert gl_backends() == expected
    monkeypatch.setattr(film_frames.sys, "platform", "darwin")
    monkeypatch.delenv("MUJOCO_GL")
    assert gl_backends() == [""]


def test_a_backend_that_fails_is_named(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    worker = tmp_path / "worker.py"
    worker.write_text("raise RuntimeError('no such driver')")
    monkeypatch.setattr(film_frames, "WORKER", worker)
    monkeypatch.setattr(film_frames, "gl_backends", lambda: ["egl"])
    with pytest.raises(NotAvailable, match=r"egl: RuntimeError: no such driver"):
        MujocoPictures(make_film(run, nominal_model(), 4, 60, 50))


def test_a_renderer_that_stops_half_way_leaves_it_to_the_drawn_leg(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    worker = tmp_path / "worker.py"
    worker.write_text(f"import sys\nsys.stdout.buffer.write(bytes(range(256)) * {480 * 426 * 3 // 256 + 1})")
    monkeypatch.setattr(film_frames, "WORKER", worker)
    monkeypatch.setattr(film_frames, "gl_backends", lambda: ["egl"])
    result = save_video(run, nominal_model(), tmp_path / "out" / "leg.gif", fps=4)
    assert result.renderer == "matplotlib"
    assert result.note == "MuJoCo's renderer (egl) stopped after 1 of 2 pictures, so the leg is drawn as lines"
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["leg.gif"]


def test_elements_are_closed_in_what_the_renderer_is_given(run: Run, tmp_path: Path) -> None:
    import mujoco

    for phase in ("swing", "stance"):
        film = make_film(run, Model(nominal_leg(), (), phase), 8, 60, 50)  # type: ignore[arg-type]
        write_scene(film, tmp_path / "model.mjb", tmp_path / "film.npz")
        model = mujoco.MjModel.from_binary_path(str(tmp_path / "model.mjb"))
        data = mujoco.MjData(model)
        with np.load(tmp_path / "film.npz") as archive:
            qpos, sites = archive["qpos"], archive["actuator_sites"]
        for k in (0, len(film.time) - 1):
            data.qpos[:] = qpos[k]
            mujoco.mj_kinematics(model, data)
            foot = film.bones.foot[k]
            np.testing.assert_allclose(data.site("foot").xpos, [foot[0], 0.0, -foot[1]], atol=1e-9)
            for i, name in enumerate(("maa", "baa")):
                np.testing.assert_allclose(data.site(f"{name}/end").xpos, data.site_xpos[sites[i, 1]], atol=1e-9)
                ends = film.bones.actuators[k, i]
                np.testing.assert_allclose(data.site_xpos[sites[i]][:, [0, 2]], ends * [1.0, -1.0], atol=1e-9)


def test_mujoco_renders_the_leg_where_it_is(run: Run, rendered: list[np.ndarray]) -> None:
    film = make_film(run, nominal_model(), 8, 240, 200)
    assert len(rendered) == len(film.time)
    drawn = list(SketchPictures(film))
    for picture, sketch in zip(rendered, drawn, strict=True):
        assert 0.5 < (picture > 250).all(axis=2).mean() < 0.97
        np.testing.assert_allclose(centre(picture, film), centre(sketch, film), atol=0.08)
        edges = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
        assert edges.min() > 250  # the whole leg is in the frame
    assert centre(rendered[-1], film)[0] < centre(rendered[0], film)[0] - 0.05
