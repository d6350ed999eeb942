"""How long `equimus-ctrl autotune-pid` takes from the command's start at the default budget, and its memory.

Run once with an empty kernel cache, as on a fresh machine, and then with a warm one.

    python benchmarks/autotune.py [--rounds 3] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def timed(folder: Path, cache: Path) -> tuple[float, float, dict]:
    """(seconds, peak memory [MiB], the command's JSON) of one run in its own process."""
    command = [sys.executable, "-c", "from equimus_ctrl.cli.main import entry; entry()", "autotune-pid", "--json"]
    command += ["--fresh", "--output", str(folder / "pid.toml"), "--results", str(folder / "results")]
    begun = time.perf_counter()
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "EQUIMUS_CACHE": str(cache), "NUMBA_CACHE_DIR": str(cache / "numba")},
    ) as process:
        assert process.stdout is not None
        output = process.stdout.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    seconds = time.perf_counter() - begun
    if process.returncode:
        raise SystemExit(f"autotune-pid ended with exit code {process.returncode}")
    return seconds, usage.ru_maxrss / 1024, json.loads(output)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    cold, warm, memory = [], [], []
    with tempfile.TemporaryDirectory() as name:
        for k in range(options.rounds):
            cache = Path(name) / f"cache{k}"
            for seconds in (cold, warm):
                taken, peak, record = timed(Path(name) / "run", cache)
                seconds.append(taken)
                memory.append(peak)
    result = {
        "cold_cache_s": statistics.median(cold),
        "warm_cache_s": statistics.median(warm),
        "all_cold_s": cold,
        "all_warm_s": warm,
        "peak_memory_mib": max(memory),
        "sets_of_gains": record["evaluated"],
        "cost_before": record["start"]["cost"],
        "cost_after": record["best"]["cost"],
    }
    print(json.dumps(result, indent=1) if options.json else "\n".join(f"{k:18s} {v}" for k, v in result.items()))


if __name__ == "__main__":
    main()
