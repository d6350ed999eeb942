"""What was found, as files for people: the report of a diagnosis, the video of a run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from equimus_ctrl import outputs, presets
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.workflow.runs import ScenarioRun


def write_report(
    found: Diagnosis, folder: Path | str, title: str = "", *, command_line: str = "", force: bool = False
) -> tuple[Path, ...]:
    """Write ``report.html``, with all figures in it, and ``record.json``.

    Args:
        found: the diagnosis.
        folder: made where it does not exist.
        title: of the page; with the model's name by default.
        command_line: that made it, where there was one.
        force: whether what an earlier report wrote there is replaced.

    Returns:
        The record and the page.

    Raises:
        ConfigError: where the folder holds earlier results, or cannot be written to.
    """
    from equimus_ctrl.report.diagnosis_page import page

    folder = Path(folder)
    results = outputs.Results(folder, force, folder)
    text = page(found, title or f"Diagnosis of {found.model.name}", command_line=command_line)
    own = results.opened(folder)
    shown = own / "report.html"
    record = outputs.write_record(own, "record.json", found.to_dict(), [shown])
    presets.write_text(shown, text)
    return record, shown


def write_video(
    found: ScenarioRun,
    path: Path | str,
    *,
    fps: float = 30,
    force: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Write a video of a run in real time; see ``report.video.save_video``.

    Args:
        found: the run.
        path: of the file, ``.mp4`` or ``.gif``; without an ffmpeg that works a film becomes a gif.
        fps: frames a second.
        force: whether a file that is there is replaced.
        progress: called with the share done.

    Returns:
        The file written.

    Raises:
        NotAvailable: for any other ending.
        ConfigError: where the file is there already or cannot be written, or for a frame rate that cannot be.
    """
    from equimus_ctrl.report.video import check_suffix, save_video

    path = Path(path)
    check_suffix(path)
    presets.check_folder(path.parent)
    for film in {path, path.with_suffix(".gif")}:
        outputs.check_new(film, force)
    return save_video(found.run, found.model, path, fps, progress=progress).path
