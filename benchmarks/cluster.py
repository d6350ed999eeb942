"""What it costs to have cases done by a Dask cluster, or by Slurm jobs, in place of local processes.

First the overhead of one piece of work that does nothing, with as much data as a case of a leg: by the wall clock, one
at a time, and processor time of the client. Then the same cases of a proof by two local processes and by two workers of
a Dask cluster, in turn, wall and processor time; with --kill a worker is killed as often while the cluster works.

    python benchmarks/cluster.py [--cases 12] [--rounds 1] [--kill SECONDS] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from equimus_ctrl.executors.base import Executor
from equimus_ctrl.executors.on_slurm import slurm_settings
from equimus_ctrl.executors.where import Where
from equimus_ctrl.proof.designs import DURATION, SAMPLE_RATE, TRIALS
from equimus_ctrl.workflow.proofs import prove

WORKERS = 2
SMALL = {"kind": "none", "trials": 2, "duration": 3.0, "baselines": False, "seed": 20261201}
"""Cases of seconds: the fewer there is to do, the more an overhead shows."""


QUIET = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.worker.memory.monitor-interval": "2s",
}
"""Of Dask, as docs/cluster.md has them: by default its processes take several per cent of a core each, idle or not."""


def nothing(data: np.ndarray) -> float:
    return float(data[0])


def spent() -> float:
    """Processor time of this process and of all that have ended [s]."""
    both = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return sum(own.ru_utime + own.ru_stime for own in both)


def of_nothing(pool: Executor, pieces: int, apart: bool, size: int) -> dict[str, float]:
    """Wall time of a piece that waits for no other, and what the client computes for it [s]."""
    data = np.random.default_rng(0).standard_normal(size)
    each = pool.each_apart if apart else pool.each
    list(each(nothing, [(data,)] * WORKERS))  # processes are there, and modules are loaded
    wall = []
    own = time.process_time()
    for _ in range(pieces):
        begun = time.perf_counter()
        list(each(nothing, [(data,), (data[:1],)]))  # one alone would be done here
        wall.append(time.perf_counter() - begun)
    client = (time.process_time() - own) / pieces
    begun = time.perf_counter()
    list(each(nothing, [(data,)] * pieces))
    return {"wall_s": statistics.median(wall), "client_cpu_s": client, "many_s": (time.perf_counter() - begun) / pieces}


@contextmanager
def cluster() -> Iterator[str]:
    """Address of a scheduler with two workers, processes of their own, which look at themselves seldom."""
    import dask
    from distributed import LocalCluster

    with (
        dask.config.set(QUIET),
        LocalCluster(n_workers=WORKERS, threads_per_worker=1, processes=True, dashboard_address=":0") as own,
    ):
        yield own.scheduler_address


@contextmanager
def killing(address: str, every: float | None) -> Iterator[list[int]]:
    """Kill a worker every so many seconds, in turn."""
    killed: list[int] = []
    over = threading.Event()

    def kill() -> None:
        from distributed import Client

        while not over.wait(every):
            with Client(address, set_as_default=False) as client:
                pids = sorted(client.run(os.getpid).values())
            chosen = pids[len(killed) % len(pids)]
            os.kill(chosen, signal.SIGKILL)
            killed.append(chosen)

    thread = threading.Thread(target=kill, daemon=True)
    if every is not None:
        thread.start()
    yield killed
    over.set()
    if every is not None:
        thread.join()


def proven(folder: Path, cases: int, **where: object) -> tuple[dict, dict[str, float]]:
    """The record of a proof, and what it took."""
    wall, cpu = time.perf_counter(), spent()
    found = prove(folder, cases=cases, **SMALL, **where)  # type: ignore[arg-type]
    record = found.to_dict()
    of_cases = [json.loads(found.request.report(k).read_text())["proof"] for k in range(cases)]
    diagnosing = {f"diagnosing_{key}": sum(own[key] for own in of_cases) for key in ("seconds", "cpu_seconds")}
    return record, {"wall_s": time.perf_counter() - wall, "cpu_s": spent() - cpu, **diagnosing}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=12)
    parser.add_argument("--pieces", type=int, default=30)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--kill", type=float, help="Seconds after which a worker is killed, again and again.")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    try:
        import distributed  # noqa: F401
        import submitit  # noqa: F401
    except ImportError as error:
        raise SystemExit(f"{error.name} is not installed; get it with: pip install 'equimus-ctrl[cluster]'") from None
    size = round(TRIALS * DURATION * SAMPLE_RATE) * 5  # time, two commands, two angles
    result: dict = {"payload_byte": 8 * size, "pieces": {}, "proofs": []}
    with tempfile.TemporaryDirectory() as name, cluster() as address:
        settings = slurm_settings({"cluster": "local", "jobs": WORKERS}, Path(name) / "jobs", "")
        for kind, where in {
            "local": Where(workers=WORKERS), "dask": Where(scheduler=address), "slurm": Where(slurm=settings)
        }.items():  # fmt: skip
            with where.opened() as pool:
                for apart in (False, True):
                    own = of_nothing(pool, options.pieces, apart, size)
                    result["pieces"][f"{kind}{', a process each' if apart else ''}"] = own
                    print(kind, "a process each" if apart else "kept processes", own, file=sys.stderr)
    cpu = spent()
    with cluster() as address, Where(scheduler=address).opened():
        pass
    result["cluster_alone_cpu_s"] = spent() - cpu
    answers = []
    for k in range(options.rounds if options.cases else 0):
        with tempfile.TemporaryDirectory() as name:
            taken = {}
            for kind in ("local", "dask") if k % 2 == 0 else ("dask", "local"):
                if kind == "local":
                    record, taken[kind] = proven(Path(name) / kind, options.cases, workers=WORKERS)
                else:
                    # With the cluster's own processes: what a worker spends is known when it has ended.
                    cpu = spent()
                    with cluster() as address, killing(address, options.kill) as killed:
                        record, taken[kind] = proven(Path(name) / kind, options.cases, scheduler=address)
                    taken[kind]["cpu_s"] = spent() - cpu
                    taken[kind]["killed"] = len(killed)
                answers.append((record["seal"], record["goals"][:10], [c["verdict"] for c in record["cases"]]))
                print(kind, taken[kind], file=sys.stderr)
            result["proofs"].append(taken)
    result["same_answers"] = all(own == answers[0] for own in answers)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
