"""A run as a video: mp4 where there is an ffmpeg, gif anywhere."""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from equimus_ctrl import outputs, presets
from equimus_ctrl.errors import ConfigError, NotAvailable
from equimus_ctrl.models.model import Model
from equimus_ctrl.report.film import Film, Frame, Strip, make_film, palette_colours
from equimus_ctrl.report.film_frames import MujocoPictures, sketch_of
from equimus_ctrl.types import Run

_Progress = Callable[[float], None] | None

WITHOUT_FFMPEG = "there is no ffmpeg for mp4 (pip install 'equimus-ctrl[video]' brings one), so it is a gif"
MP4_SIZE = (720, 640)
GIF_SIZE = (480, 426)
GIF_FRAMES = 600
GIF_DELAY = 5  # [1/100 s], the least that viewers keep to


@dataclass(frozen=True)
class VideoResult:
    """A video that was written.

    Attributes:
        path: of the file; ends in ``.gif`` where an mp4 was asked for and could not be written.
        renderer: ``"mujoco (egl)"`` or another OpenGL backend, or ``"matplotlib"``.
        note: why something else than asked for was done, or an empty text.
    """

    path: Path
    renderer: str
    note: str = ""


def check_video(path: Path, force: bool = False) -> str:
    """What is known of a video before anything is simulated: whether it can be written, and if not as asked for, why.

    Args:
        path: of the file; ends in ``.mp4`` or ``.gif``.
        force: whether what is there already is replaced.

    Returns:
        Why it becomes a gif, as a sentence; "" where it does not.

    Raises:
        NotAvailable: for any other ending.
        ConfigError: where it cannot be written, or something is there already.
    """
    suffix = check_suffix(path)
    presets.check_place(path)
    without = suffix == ".mp4" and find_ffmpeg() is None
    for film in {path, path.with_suffix(".gif")} if suffix == ".mp4" else {path}:
        outputs.check_new(film, force)
        presets.check_place(film)
    return f"{WITHOUT_FFMPEG}: {path.with_suffix('.gif')}" if without else ""


def check_suffix(path: Path) -> str:
    """The kind of video a file's name asks for, ``.mp4`` or ``.gif``.

    Raises:
        NotAvailable: for any other.
    """
    suffix = path.suffix.lower()
    if suffix not in (".mp4", ".gif"):
        raise NotAvailable(
            f"{path}: a video can be written as .mp4 or .gif, not as {suffix or 'a file without ending'}"
        )
    return suffix


def save_video(
    run: Run, model: Model, path: Path, fps: float = 30, *, progress: Callable[[float], None] | None = None
) -> VideoResult:
    """Write a video of a robot going through a run, in real time, whole or not at all.

    MuJoCo renders it where OpenGL works without a screen (``MUJOCO_GL`` names the backend to try first, ``off``
    forbids it); else it is drawn as lines, an XML's robot as the outlines of its geoms. Below are curves of the joints,
    dashed where they are wanted, and bars of the commands. A gif has at most 20 frames a second and 600 in all.

    Args:
        run: what happened.
        model: whose robot and phase are shown.
        path: ends in ``.mp4`` or ``.gif``.
        fps: frames a second.
        progress: called with the share done; it starts again where one way of writing fails and another is tried.

    Raises:
        NotAvailable: for any other ending.
        ConfigError: for a frame rate that cannot be, or where the run is not of the model's robot.
    """
    suffix = check_suffix(path)
    if not 1 <= fps <= 120:
        raise ConfigError(f"frame rate is {fps:g} a second, expected 1 to 120")
    notes: list[str] = []
    ffmpeg = find_ffmpeg() if suffix == ".mp4" else None
    if suffix == ".mp4" and ffmpeg is None:
        notes.append(WITHOUT_FFMPEG)
    if ffmpeg is not None:
        try:
            film = make_film(run, model, fps, *MP4_SIZE)
            renderer = _write(film, path, ffmpeg, notes, progress)
            return VideoResult(path, renderer, "; ".join(notes))
        except _EncoderError as error:
            notes = [f"ffmpeg could not write an mp4 ({error}), so it is a gif"]
    path = path.with_suffix(".gif")
    duration = float(run.time[-1] - run.time[0])
    delay = max(GIF_DELAY, math.ceil(100 / fps), math.ceil(100 * duration / GIF_FRAMES))
    renderer = _write(make_film(run, model, 100 / delay, *GIF_SIZE), path, None, notes, progress)
    return VideoResult(path, renderer, "; ".join(notes))


def save_frames(frames: Sequence[Frame], path: Path, fps: float) -> VideoResult:
    """Write pictures as a video, whole or not at all; as a gif where no ffmpeg writes an mp4.

    Args:
        frames: (height, width, 3) each, alike, of even height and width.
        path: ends in ``.mp4`` or ``.gif``.
        fps: pictures a second.

    Raises:
        NotAvailable: for any other ending.
    """
    suffix, note = check_suffix(path), ""
    size = (frames[0].shape[1], frames[0].shape[0])
    ffmpeg = find_ffmpeg() if suffix == ".mp4" else None
    if ffmpeg is not None:
        try:
            _put(iter(frames), path, fps, size, ffmpeg, ())
            return VideoResult(path, "frames")
        except _EncoderError as error:
            note = f"ffmpeg could not write an mp4 ({error}), so it is a gif"
    elif suffix == ".mp4":
        note = WITHOUT_FFMPEG
    own = path.with_suffix(".gif")
    _put(iter(frames), own, fps, size, None, sorted({(int(r), int(g), int(b)) for r, g, b in _other_colours(frames)}))
    return VideoResult(own, "frames", note)


def _other_colours(frames: Sequence[Frame]) -> Frame:
    """Colours of the pictures in the middle and at the end, which the first may not show."""
    seen = np.concatenate([frames[k].reshape(-1, 3) for k in (len(frames) // 2, -1)])
    return np.asarray(np.unique(seen // 32 * 32, axis=0))


def find_ffmpeg() -> str | None:
    """The ffmpeg that imageio-ffmpeg brings, or the system's, or None."""
    try:
        import imageio_ffmpeg  # type: ignore[import-not-found,import-untyped,unused-ignore]

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        return shutil.which("ffmpeg")


class _EncoderError(Exception):
    pass


def _write(film: Film, path: Path, ffmpeg: str | None, notes: list[str], progress: _Progress) -> str:
    """Write with MuJoCo's pictures or, where there are none, with drawn ones; the renderer's name."""
    try:
        rendered = MujocoPictures(film)
        try:
            _encode(film, rendered, path, ffmpeg, progress)
        finally:
            rendered.close()
        return f"mujoco ({rendered.backend})"
    except NotAvailable as error:
        sketch = sketch_of(film)
        notes.append(f"{error}, so {sketch.said}")
    _encode(film, sketch, path, ffmpeg, progress)
    return sketch.backend


def _encode(film: Film, pictures: Iterable[Frame], path: Path, ffmpeg: str | None, progress: _Progress) -> None:
    strip = Strip(film)

    def drawn() -> Iterator[Frame]:
        for k, picture in enumerate(pictures):
            yield strip.under(picture, k)
            if progress is not None:
                progress((k + 1) / len(film.time))

    _put(drawn(), path, film.fps, (film.width, film.height + strip.height), ffmpeg, palette_colours(film))


def _put(
    frames: Iterator[Frame],
    path: Path,
    fps: float,
    size: tuple[int, int],
    ffmpeg: str | None,
    colours: Sequence[tuple[int, int, int]],
) -> None:
    """Write frames whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=f".tmp{path.suffix}")
    os.close(handle)
    try:
        if ffmpeg is None:
            _gif(frames, Path(temporary), fps, colours)
        else:
            _mp4(frames, Path(temporary), fps, size, ffmpeg)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    finally:
        Path(temporary).unlink(missing_ok=True)


def _mp4(frames: Iterator[Frame], path: Path, fps: float, size: tuple[int, int], ffmpeg: str) -> None:
    wide = f"{size[0]}x{size[1]}"
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", wide, "-r", f"{fps:g}", "-i", "-", "-an"]
    target = ["-c:v", "libx264", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    command = [ffmpeg, "-y", "-loglevel", "error", *source, *target, str(path)]
    with tempfile.TemporaryFile() as log:
        try:
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=log)
        except OSError as error:
            raise _EncoderError(str(error)) from None
        assert process.stdin is not None
        try:
            with contextlib.suppress(BrokenPipeError), process.stdin:
                for frame in frames:
                    process.stdin.write(frame.tobytes())
            code = process.wait()
        except BaseException:
            process.kill()
            process.wait()
            raise
        if code != 0:
            log.seek(0)
            said = log.read().decode(errors="replace").strip().splitlines()
            raise _EncoderError(said[-1][:160] if said else f"exit code {code}")


def _gif(frames: Iterator[Frame], path: Path, fps: float, colours: Sequence[tuple[int, int, int]]) -> None:
    first = Image.fromarray(next(frames))
    # One palette for all frames keeps what stands still the same, and so the file small.
    sample = Image.new("RGB", (first.width, first.height + 8 * len(colours)))
    sample.paste(first)
    for i, colour in enumerate(colours):
        sample.paste(colour, (0, first.height + 8 * i, first.width, first.height + 8 * i + 8))
    palette = sample.quantize(255)

    def reduced() -> Iterator[Image.Image]:
        for frame in frames:
            yield Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)

    first.quantize(palette=palette, dither=Image.Dither.NONE).save(
        path, save_all=True, append_images=reduced(), duration=round(1000 / fps), loop=0, optimize=False
    )
