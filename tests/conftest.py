"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hypothesis
import pytest

from equimus_ctrl.workflow import plugins

if TYPE_CHECKING:
    from hardware_rig import MemoryWire
    from wrong_input import Ran

    from equimus_ctrl.diagnosis.results import Diagnosis
    from equimus_ctrl.plants.hardware.transport import Sample
    from equimus_ctrl.plants.mujoco_plant import MujocoPlant
    from equimus_ctrl.report.diagnosis_panels import Scene

# The same examples in every run; `--hypothesis-profile=default` draws new ones.
hypothesis.settings.register_profile(
    "repeatable",
    derandomize=True,
    deadline=None,
    max_examples=50,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("repeatable")


LONG = (
    "test_readme", "test_mjcf_diagnosis", "test_fuzz", "test_coupled_joints", "test_experiment_runs",
    "test_diagnosis_budget", "test_plant_tuning", "test_prescribed_diagnosis", "test_autotune_cluster",
    "test_prove_shards", "test_benchmarks", "test_diagnosis", "test_mjcf_muscles", "test_diagnosis_units",
)  # fmt: skip
"""Files begun early, the longest first, for whoever runs the last of them runs it alone."""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests in real time come first, where they wait for one another alone, and may fail twice; long files come next.

    What a test in real time cannot prevent is a neighbour on the host that takes the clock, and that passes.
    """
    clocked = set()
    for item in items:
        if item.get_closest_marker("real_time") is not None:
            item.add_marker(pytest.mark.flaky(reruns=2, reruns_delay=3))
            clocked.add(item.path)
    place = {stem: k for k, stem in enumerate(LONG)}
    items.sort(key=lambda item: (item.path not in clocked, place.get(item.path.stem, len(LONG))))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """A test in real time, with all it sets up, has the machine to itself; others run side by side (``-n``)."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return (yield)
    with _turn(alone=item.get_closest_marker("real_time") is not None):
        return (yield)


@contextmanager
def _turn(alone: bool) -> Iterator[None]:
    import fcntl

    with open(__file__) as door, open(Path(__file__).with_name("hardware_rig.py")) as room:  # files to lock, no more
        # Who waits to be alone keeps the door shut, so that nobody overtakes it for ever.
        fcntl.flock(door, fcntl.LOCK_EX)
        fcntl.flock(room, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
        fcntl.flock(door, fcntl.LOCK_UN)
        yield


@pytest.fixture(scope="session")
def recordings_dir() -> Path:
    """The folder of real recordings: EQUIMUS_RECORDINGS, or ../shared/recordings beside the checkout."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "recordings"
    folder = Path(os.environ.get("EQUIMUS_RECORDINGS") or beside)
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}; EQUIMUS_RECORDINGS can name a folder that has them")
    return folder


@pytest.fixture(scope="session")
def leg_dir(recordings_dir: Path) -> Path:
    """The folder with the recordings of the real leg."""
    for folder in (recordings_dir, recordings_dir / "equimus_leg"):
        if (folder / "triangle.csv").is_file():
            return folder
    pytest.skip(f"no recordings of the leg (triangle.csv) in {recordings_dir}")


@pytest.fixture(autouse=True)
def catalogue() -> Iterator[None]:
    """Effects, controllers, plants and scenarios that a test makes known are gone after it."""
    registries: list[dict[Any, Any]] = [*plugins.known(), plugins._loaded]
    before = [dict(known) for known in registries]
    yield
    for known, held in zip(registries, before, strict=True):
        known.clear()
        known.update(held)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages have empty figures: for tests of what they say."""
    from matplotlib.figure import Figure

    from equimus_ctrl.report import diagnosis_page, style

    monkeypatch.setattr(style, "drawn", lambda drawings: {name: Figure() for name in drawings})
    monkeypatch.setattr(diagnosis_page, "summary_figure", lambda *args, **options: Figure())


@pytest.fixture(scope="session")
def wrong_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with something wrong of every kind; whoever writes into it is found out."""
    from wrong_input import fill

    folder = tmp_path_factory.mktemp("errors")
    fill(folder)
    return folder


@pytest.fixture
def run_there(
    wrong_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., Ran]:
    """Run the command in the folder with wrong files; fail where it wrote, printed to standard output or showed a trace."""
    from wrong_input import snapshot

    from equimus_ctrl.cli.main import main

    monkeypatch.chdir(wrong_folder)
    monkeypatch.setenv("EQUIMUS_RECORDINGS", str(wrong_folder / "nothing"))
    monkeypatch.setenv("COLUMNS", "100")

    def call(arguments: Sequence[object], texts: dict[str, str] | None = None) -> Ran:
        for name, text in (texts or {}).items():
            (wrong_folder / name).write_text(text)
        before = snapshot(wrong_folder)
        try:
            code = main([str(argument) for argument in arguments])
            out, err = capsys.readouterr()
            assert snapshot(wrong_folder) == before, "something was written"
        finally:
            for path in wrong_folder.rglob("*"):
                if path.is_file() and str(path.relative_to(wrong_folder)) not in before:
                    path.unlink()
            for name in texts or {}:
                (wrong_folder / name).unlink()
        assert out == "" and "Traceback" not in err
        return code, out, err

    return call


@pytest.fixture(scope="session")
def diagnosis() -> Diagnosis:
    """A leg whose BAA has a dead zone, its parameters and the threshold fitted; found, and something left besides."""
    from diagnosed_leg import diagnosed

    return diagnosed()


@pytest.fixture(scope="session")
def scene(diagnosis: Diagnosis) -> Scene:
    """What the curves of that diagnosis are drawn from."""
    from equimus_ctrl.report.diagnosis_panels import Scene

    return Scene.of(diagnosis)


@pytest.fixture(scope="module")
def plant() -> MujocoPlant:
    """The nominal leg without effects or noise; every test resets it first."""
    from equimus_ctrl.models.model import nominal_model
    from equimus_ctrl.plants.mujoco_plant import MujocoPlant

    return MujocoPlant(nominal_model())


@pytest.fixture
def wires() -> Iterator[Callable[..., MemoryWire]]:
    """Makes robots in memory; what they began ends with the test."""
    from hardware_rig import MemoryWire

    made: list[MemoryWire] = []

    def make(measure: Callable[[int, float], Sequence[Sample]] | None = None) -> MemoryWire:
        made.append(MemoryWire(measure))
        return made[-1]

    yield make
    for wire in made:
        wire.close()
