"""The hardware plant over DDS against an emulator in another process, on loopback: jitter, latency, and faults.

1. Loop at 120 Hz with PID, LQR and NMPC on the triangle: by how much later than due each instant begins, from a
   measurement's stamp to the command made of it, deadlines missed.
2. Faults, each so many times at instants drawn at random: does every one vent and say why, is nothing beyond the limits
   ever received, and can what was recorded until then be read?
   Of the network and the device those of `emulate --fault`; besides 5 % and 30 % loss, which are to be borne, a
   controller killed with SIGKILL, which the device's watchdog has to vent, and a second publisher.

    python benchmarks/hardware.py [--times 20] [--seconds 20] [--seed 0] [--output FILE.json] [--without-faults]
                                   [--only FAULT …]
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from hardware_rig import DOMAIN, LOOPBACK, emulator, quick, seen_by, within_limits

os.environ["CYCLONEDDS_URI"] = LOOPBACK

import numpy as np
from rich.progress import track

from equimus_ctrl.errors import HardwareFault, NotAvailable
from equimus_ctrl.loop import run
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.plants.hardware.plant import HardwarePlant
from equimus_ctrl.recordings import read
from equimus_ctrl.workflow import load_controller, load_scenario

MODEL, LOW, SLEW = nominal_model(), np.array([5e3, 3e3]), 1e6
VENTING = {
    "stall": "stall:{t}:0.2", "silent": "silent:{t}", "nan": "nan:{t}:0.05", "jump": "jump:{t}:0.1",
    "clock": "clock:{t}:1", "back": "back:{t}:1", "second_publisher": "second_publisher:{t}:1", "crash": "crash:{t}",
}  # fmt: skip
BORNE = {
    "repeat": ("--fault", "repeat:{t}:1"), "reorder": ("--fault", "reorder:{t}:1"), "5 % loss": ("--loss", "0.05"),
    "30 % loss": ("--loss", "0.3"),
}  # fmt: skip
KILLED = """
import sys
sys.path.insert(0, {tests!r})
from pathlib import Path
from hardware_rig import quick
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.plants.hardware.plant import HardwarePlant
plant = HardwarePlant(nominal_model(), quick({domain}), armed=True, record=Path({record!r}))
plant.reset()
while True:
    plant.step([5e3, 3e3])
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--without-faults", action="store_true")
    parser.add_argument(
        "--only", action="append", metavar="FAULT", help="this fault alone, without the loop; repeatable"
    )
    given = parser.parse_args()
    if importlib.util.find_spec("cyclonedds") is None:
        raise SystemExit("Cyclone DDS is not installed; get it with: pip install 'equimus-ctrl[hardware]'")
    record: dict[str, Any] = {"seed": given.seed, "times": given.times}
    with tempfile.TemporaryDirectory() as folder:
        if not given.only:
            record["loop"] = loop(Path(folder), given.seconds)
        if not given.without_faults:
            names = given.only or [*VENTING, *BORNE, "killed"]
            record["faults"] = faults(Path(folder), names, given.times, given.seed)
    if given.output:
        given.output.write_text(json.dumps(record, indent=1))


def loop(folder: Path, seconds: float) -> dict[str, Any]:
    """Of the loop itself."""
    record: dict[str, Any] = {}
    scenario = load_scenario("triangle", MODEL.morphology, search=False)
    print("loop at 120 Hz: begun later than due, measurement to command (median, p99), deadlines missed")
    for name in ("pid", "lqr", "nmpc"):
        own = load_controller(name, scenario, None, MODEL.morphology)
        with emulator(folder / f"{name}.json"), closing(HardwarePlant(MODEL, quick(), armed=True)) as plant:
            run(plant, own, scenario.reference, seconds, start=scenario.start)
            found = record[name] = plant.counts.to_dict()
        print(
            f"  {name:5s} {1e3 * found['lateness_p50_s']:5.2f} {1e3 * found['lateness_p99_s']:5.2f} ms   "
            f"{1e3 * found['latency_p50_s']:5.2f} {1e3 * found['latency_p99_s']:5.2f} ms   "
            f"{found['deadlines_missed']} of {found['instants']}",
            flush=True,
        )
    return record


def faults(folder: Path, names: list[str], times: int, seed: int) -> dict[str, Any]:
    """Each so many times."""
    rng = np.random.default_rng(seed)
    record: dict[str, Any] = {}
    print(f"each {times} times: as it has to be, within the limits, recording readable; why")
    for name in names:
        unmet = 0
        tally = {"as_it_has_to_be": 0, "within_limits": 0, "readable": 0}
        reasons: Counter[str] = Counter()
        for k in track(range(times), name, transient=True):
            log, path = folder / f"{name}-{k}.json", folder / f"{name}-{k}.csv"
            at = f"{rng.uniform(2.5, 4.0):.3f}"
            try:
                right, why, seen = _killed(log, path, rng) if name == "killed" else _faulted(name, at, log, path)
            except NotAvailable as silent:  # nothing was begun: the two have not found each other
                print(f"  {name} {k}: {silent}", flush=True)
                unmet += 1
                continue
            reasons[why.partition(": ")[2][:40] or why or "none"] += 1
            tally["as_it_has_to_be"] += right
            tally["within_limits"] += seen is None or within_limits(seen, np.inf if "loss" in name else SLEW / 120)
            tally["readable"] += len(read(path).time) > 10
        record[name] = {**tally, "not_begun": unmet, "reasons": dict(reasons)}
        print(
            f"  {name:10s} {' '.join(str(value) for value in tally.values())}   {dict(reasons.most_common(2))}",
            flush=True,
        )
    return record


def _faulted(name: str, at: str, log: Path, path: Path) -> tuple[bool, str, dict[str, Any] | None]:
    options = ("--fault", VENTING[name].format(t=at)) if name in VENTING else BORNE[name]
    options = tuple(option.format(t=at) for option in options)
    why = ""
    with emulator(log, *options), closing(HardwarePlant(MODEL, quick(), armed=True, record=path)) as plant:
        try:
            plant.reset()
            for k in range(480):
                plant.step(LOW * (1 + 0.3 * np.sin(k / 30)))
        except HardwareFault as fault:
            why = str(fault)
        plant.close()
        time.sleep(0.15)
    seen = None if name == "crash" else seen_by(log)
    if name in VENTING:
        # By the host, not by the watchdog, and soon.
        late = 0.0 if seen is None else seen["vented"] - float(at)
        return why.startswith("vented") and (seen is None or (seen["watchdog"] == 0 and 0 <= late < 0.5)), why, seen
    return why == "", why, seen


def _killed(log: Path, path: Path, rng: np.random.Generator) -> tuple[bool, str, dict[str, Any]]:
    code = KILLED.format(tests=str(Path(__file__).resolve().parents[1] / "tests"), domain=DOMAIN, record=str(path))
    with emulator(log) as robot:
        process = subprocess.Popen([sys.executable, "-c", code])
        while not path.exists():
            time.sleep(0.05)
            if process.poll() is not None:
                raise NotAvailable(f"the controller ended with {process.returncode}")
        time.sleep(float(rng.uniform(0.5, 1.5)))
        process.send_signal(signal.SIGKILL)
        process.wait()
        time.sleep(0.3)
        robot.send_signal(signal.SIGTERM)
        robot.wait(20)
    seen = seen_by(log)
    return seen["watchdog"] == 1 and seen["vented"] is not None, "the device's watchdog", seen


if __name__ == "__main__":
    main()
