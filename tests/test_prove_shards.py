"""Proofs shared out: over shards that are merged, over a Dask cluster that loses a worker, with the answers of one run."""

from __future__ import annotations

import json
import os
import shutil
import signal
import threading
from pathlib import Path
from typing import Any

import pytest
from test_prove import World

from equimus_ctrl.cli.main import main
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.executors.versions import OtherProcessor, processor, versions
from equimus_ctrl.options import ProveOptions, Shard
from equimus_ctrl.proof import blind
from equimus_ctrl.workflow import proof_shards
from equimus_ctrl.workflow.proofs import prove


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


# --- shards


def test_a_shard_is_every_so_many_th_case() -> None:
    assert [list(Shard(k, 3).cases(8)) for k in (1, 2, 3)] == [[0, 3, 6], [1, 4, 7], [2, 5]]
    assert Shard.read("2/5") == Shard(2, 5) and str(Shard(2, 5)) == "2/5"


@pytest.mark.parametrize("text", ["0/5", "6/5", "2", "a/b", "2/", "-1/3", "1.5/3"])
def test_what_is_no_shard(text: str) -> None:
    with pytest.raises(ConfigError, match="expected i/n with i from 1 to n, such as 2/5"):
        Shard.read(text)


def test_options_that_do_not_go_together(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="shard 3/3 of 2 cases has none"):
        ProveOptions(cases=2, shard=Shard(3, 3))
    with pytest.raises(ConfigError, match="--shard and --merge are given, expected one"):
        ProveOptions(shard=Shard(1, 2), merge=(tmp_path,))
    with pytest.raises(ConfigError, match="--workers and --slurm are given, expected one"):
        ProveOptions(workers=2, slurm=tmp_path / "jobs.toml")
    with pytest.raises(ConfigError, match="scheduler is 'head', expected an address such as tcp://head:8786"):
        ProveOptions(scheduler="head")


def test_a_shard_does_its_cases_alone_and_is_not_judged(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    world.reports[1] = world.reports[0]  # a wrong answer
    given = ["--cases", "2", "--no-figures", "--no-baselines", "--kind", "single", "--output", str(tmp_path)]
    assert main(["prove", *given, "--shard", "2/2", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["shard"] == "2/2" and world.events == ["diagnosed case_0001"]
    names = {path.name for path in tmp_path.iterdir() if path.is_file()}
    assert names == {"request.json", "seals_2_of_2.txt", "score_2_of_2.json", "score_2_of_2.md"}
    # The other one into the same folder, and then all.
    world.prove(tmp_path, kind="single", shard=Shard(1, 2), baselines=False)
    world.tasks.clear()
    world.prove(tmp_path, kind="single", baselines=False)
    assert not world.tasks and "2 of 2 cases were diagnosed before" in world.events


class Shards:
    """Two shards in folders of their own, and what merging them says."""

    def __init__(self, world: World, root: Path) -> None:
        self.world, self.folders, self.whole = world, [root / "one", root / "two"], root / "whole"
        for k, folder in enumerate(self.folders):
            world.prove(folder, shard=Shard(k + 1, 2), baselines=False)
            for case in range(k, 2, 2):  # what this world does not make
                (folder / "recordings" / f"case_000{case}").mkdir(parents=True)
                for name in ("truth", "seals"):
                    (folder / name).mkdir(exist_ok=True)
                (folder / "truth" / f"case_000{case}.json").write_text("{}")
                (folder / "seals" / f"case_000{case}.txt").write_text("seal")

    def merge(self, **options: Any) -> Any:
        return self.world.prove(self.whole, **{"merge": self.folders, "baselines": False, **options})

    def record(self, k: int, **changes: Any) -> None:
        path = self.folders[k] / "shards" / f"{k + 1}_of_2.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


@pytest.fixture
def shards(world: World, tmp_path: Path) -> Shards:
    return Shards(world, tmp_path)


def test_shards_are_merged(shards: Shards) -> None:
    shards.world.tasks.clear()
    found = shards.merge()
    assert not shards.world.tasks and len(found.score.cases) == 2 and found.shard is None
    assert sorted(path.name for path in (shards.whole / "reports").iterdir()) == ["case_0000.json", "case_0001.json"]
    assert len(shards.merge(merge=[*shards.folders, shards.whole][:2]).score.cases) == 2  # and again


def test_shards_that_do_not_fit(shards: Shards, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no shard that is done has case 1 of 2; expected all shards"):
        shards.merge(merge=shards.folders[:1])
    with pytest.raises(ConfigError, match="one: holds shard 1/2 of 2 cases, not of 3; expected --cases 2"):
        shards.merge(cases=3)
    with pytest.raises(ConfigError, match="one: holds a proof with seed 0, not 4; choose another folder"):
        shards.merge(seed=4)
    with pytest.raises(ConfigError, match="one: shard 1/2 has no answers of the baselines; expected --no-baselines"):
        shards.merge(baselines=True)
    with pytest.raises(ConfigError, match="nowhere: holds no proof"):
        shards.merge(merge=[tmp_path / "nowhere"])
    (tmp_path / "half").mkdir()
    shutil.copy(shards.folders[0] / "request.json", tmp_path / "half")
    with pytest.raises(ConfigError, match="half: holds no shard that is done; run prove --shard with it as --output"):
        shards.merge(merge=[tmp_path / "half"])
    assert not shards.whole.exists()


def test_shards_of_another_processor_are_merged_with_a_warning(shards: Shards) -> None:
    shards.record(1, processor={**processor(), "blas": "openblas Prescott"})
    with pytest.warns(OtherProcessor, match=r"two: shard 2/2 has another processor \(blas openblas Prescott, not "):
        assert len(shards.merge().score.cases) == 2


def test_shards_of_another_version_are_not_merged(shards: Shards) -> None:
    shards.record(1, versions={**versions(), "numpy": "1.0"})
    with pytest.raises(ConfigError, match=r"two: shard 2/2 was made with numpy 1\.0, not .* as the shards in .*one"):
        shards.merge()
    shards.record(1, fingerprint="f" * 64)
    with pytest.raises(ConfigError, match="two: shard 2/2 was diagnosed by another version of the program"):
        shards.merge()
    (shards.folders[1] / "shards" / "2_of_2.json").write_text("[]")
    with pytest.raises(ConfigError, match="2_of_2.json: is no record of a shard"):
        shards.merge()


# --- real ones

CASES: dict[str, Any] = {"cases": 3, "kind": "none", "trials": 2, "duration": 3.0, "baselines": False, "seed": 11}
TIMES = ("seconds", "cpu_seconds", "peak_memory_byte", "effort")


def timeless(value: Any) -> Any:
    """Without what a clock says, and how much memory there was."""
    if isinstance(value, dict):
        clocked = str(value.get("name", "")).startswith(("longest", "quick", "seconds"))
        return {} if clocked else {key: timeless(item) for key, item in value.items() if key not in TIMES}
    return [timeless(item) for item in value] if isinstance(value, list) else value


def contents(folder: Path) -> dict[str, Any]:
    """All files of a proof by name: bytes, of answers what no clock says."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and not name.startswith(("shards/", "seals_")):
            answer = name.startswith("reports/")
            found[name] = timeless(json.loads(path.read_text())) if answer else path.read_bytes()
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A proof in one run, on two processes of this computer, and its record."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, timeless(prove(folder, workers=2, **CASES).to_dict())


@pytest.mark.slow
def test_shards_merged_are_the_whole_to_the_byte(whole: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    folders = [tmp_path / "one", tmp_path / "two"]
    for k, folder in enumerate(folders):
        prove(folder, shard=Shard(k + 1, 2), workers=1, **CASES)
    merged = prove(tmp_path / "merged", merge=folders, **CASES)
    assert timeless(merged.to_dict()) == whole[1]
    assert contents(tmp_path / "merged") == contents(whole[0])
    assert set(contents(whole[0])) >= {"request.json", "seals.txt", "truth/case_0002.json", "reports/case_0002.json"}
    path = folders[0] / "truth" / "case_0000.json"
    path.write_text(path.read_text().replace("none", "nine"))
    with pytest.raises(ConfigError, match="it was changed after it was sealed"):
        prove(tmp_path / "changed", merge=folders, **CASES)


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_gives_the_same_to_the_byte(
    whole: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed")
    own = distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0")
    killed: list[int] = []

    def kill(stage: str, done: int, total: int) -> None:
        """A worker as simulating and as diagnosing goes on: what it has begun is lost."""
        if done == 1 and stage != "scoring":
            with distributed.Client(own, set_as_default=False) as client:
                pid = min(client.run(os.getpid).values())
            threading.Timer(0.5, os.kill, (pid, signal.SIGKILL)).start()
            killed.append(pid)

    with own:
        found = prove(tmp_path / "dask", scheduler=own.scheduler_address, progress=kill, **CASES)
    assert len(killed) == 2
    assert timeless(found.to_dict()) == whole[1]
    assert contents(tmp_path / "dask") == contents(whole[0])


@pytest.mark.long
@pytest.mark.slow
def test_jobs_give_the_same_to_the_byte(
    whole: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("submitit")
    (tmp_path / "jobs.toml").write_text('cluster = "local"\njobs = 2\ntimeout_min = 10\n')
    given = "--cases 3 --kind none --trials 2 --duration 3 --no-baselines --seed 11 --no-figures --json"
    options = ["--slurm", str(tmp_path / "jobs.toml"), "--output", str(tmp_path / "slurm")]
    assert main(["prove", *given.split(), *options]) in (0, 3)
    record = json.loads(capsys.readouterr().out)
    del record["files"]
    assert timeless(record) == json.loads(json.dumps(whole[1]))
    for name in ("score.json", "score.md"):
        (tmp_path / "slurm" / name).unlink()
    assert contents(tmp_path / "slurm") == contents(whole[0])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["jobs.toml", "slurm"]
    (tmp_path / "jobs.toml").write_text("partiton = 'cpu'\n")
    assert main(["prove", *given.split(), *options]) == 2
    assert "jobs.toml: there is no setting of jobs 'partiton'; did you mean 'partition'?" in capsys.readouterr().err


def test_what_a_shard_says_of_itself(shards: Shards) -> None:
    record = json.loads((shards.folders[1] / "shards" / "2_of_2.json").read_text())
    assert record["schema"] == proof_shards.SCHEMA and (record["shard"], record["of"], record["cases"]) == (2, 2, 2)
    assert record["fingerprint"] == blind.report_fingerprint(False) and record["versions"] == versions()
