"""Real machines with friction (and whatever else) concealed from their models, diagnosed: ``python run.py [NAME …]``.

Each case has a nominal model without what others have measured, and recordings that show it. What is found is printed
beside the figures that were published, and written to ``--output`` (``record.json`` and ``report.html`` a case).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from equimus_ctrl import presets, workflow
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.identification.parameters import default_bounds
from equimus_ctrl.models.model import Model
from equimus_ctrl.report.diagnosis_page import page
from equimus_ctrl.robots.mjcf.robot import mjcf_of

HERE = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Case:
    """One machine.

    Attributes:
        title: for people.
        model: file beside this one; or the name of the case whose corrected model it goes on from, what that found
            being known within its intervals.
        recordings: folder that ``convert.py`` writes.
        free: what may be wrong about the model's numbers.
        heldout: patterns of the trials that judge.
        published: what others found, for people.
        figures: further numbers of what was found.
    """

    title: str
    model: str
    recordings: str
    free: tuple[str, ...]
    heldout: tuple[str, ...] = ()
    published: str = ""
    figures: Callable[[Diagnosis], Mapping[str, float]] = field(default=lambda found: {})


def leverage(model: Model) -> float:
    """What gravity pulls at a single hinge with, mass times distance [kg·m], as weighed by the motor's gain."""
    from equimus_ctrl.engines.mjcf_realised import realise

    own = realise(model).mujoco
    return float(own.body_mass[1] * -own.body_ipos[1, 2] / own.actuator_gainprm[0, 0])


CASES = {
    "emps": Case(
        "EMPS, all friction concealed",
        "emps.xml",
        "emps",
        ("carriage.mass",),
        ("*pulses",),
        "M 95.11 kg, viscous 203.5 N·s/m, Coulomb 20.39 N, offset −3.16 N",
    ),
    "emps_asymmetry": Case(
        "EMPS, only the difference between directions concealed",
        "emps_symmetric.xml",
        "emps",
        ("carriage.mass", "screw.damping", "screw.frictionloss"),
        ("*pulses",),
        "viscous 166.7 forwards against 240.4 N·s/m backwards",
    ),
    "simple_pendulum": Case(
        "simple pendulum, friction concealed",
        "simple_pendulum.xml",
        "simple_pendulum",
        ("arm.mass", "arm.inertia"),
        (),
        "viscous 0.047 N·m·s/rad, Coulomb 0.184 N·m",
        lambda found: {"m·l [kg·m]": leverage(found.corrected)},
    ),
    "heavier_bob": Case(
        "simple pendulum, 1 kg bob with the model of the lighter one",
        "simple_pendulum",
        "simple_pendulum_1kg",
        ("hinge.*.*",),
        (),
        "m·g·l 1.75 times as large",
        lambda found: {"m·g·l over that of the model": leverage(found.corrected) / leverage(found.model)},
    ),
    "double_pendulum": Case(
        "double pendulum C1, friction concealed",
        "double_pendulum_c1.xml",
        "double_pendulum_c1",
        ("*.mass", "*.inertia"),
        (),
        "Coulomb 0.16 and 0.12 N·m",
    ),
    "double_pendulum_compensated": Case(
        "double pendulum A0, its friction compensated by its controller",
        "double_pendulum_a0.xml",
        "double_pendulum_a0",
        ("*.mass", "*.inertia"),
        (),
        "much less than without",
    ),
    "double_pendulum_asked": Case(
        "double pendulum A0, the torque without what compensates friction",
        "double_pendulum_a0.xml",
        "double_pendulum_a0_asked",
        ("*.mass", "*.inertia"),
        (),
        "much less than in the recorded torque",
    ),
    "emps_loop": Case(
        "EMPS in closed loop, its goal as command, all friction concealed",
        "emps_loop.xml",
        "emps_loop",
        ("carriage.mass",),
        (),
        "viscous 203.5 N·s/m, Coulomb 20.39 N",
    ),
    "xl330": Case(
        "XL330 servo, friction concealed",
        "xl330.xml",
        "xl330",
        ("horn.armature", "servo.kp", "servo.kd"),
        ("sin_time_square*",),
        "friction that grows with the load",
    ),
}


def intervals(model: Model, record: Path, free: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Between what those numbers of a case's findings lie that some patterns fit, by its record: 95 % intervals."""
    known = dict[str, tuple[float, float]]()
    for finding in json.loads(record.read_text(encoding="utf-8"))["findings"]:
        for place, (key, own) in product(finding["locations"], finding["parameters"].items()):
            name = f"{place}.{finding['effect']}.{key}"
            if any(fnmatch(name, pattern) for pattern in free):
                low, high = default_bounds(model, name)
                ends = (low if own["low"] is None else own["low"], high if own["high"] is None else own["high"])
                known[name] = max(low, ends[0]), min(high, ends[1])
    return known


def diagnosed(name: str, folder: Path, output: Path) -> Diagnosis:
    """A case diagnosed, its record, page and corrected model written."""
    case = CASES[name]
    goes_on = not case.model.endswith(".xml")
    source = output / case.model / "corrected.toml" if goes_on else HERE / case.model
    model = workflow.load_model(source)
    bounds = intervals(model, output / case.model / "record.json", case.free) if goes_on else None
    found = workflow.diagnose(
        [folder / case.recordings], model, free=case.free, bounds=bounds, validation=case.heldout,
        progress=lambda stage, share, best: print(f"  {share:4.0%} {stage}: {best}", flush=True),
    )  # fmt: skip
    own = output / name
    own.mkdir(parents=True, exist_ok=True)
    presets.write_text(own / "record.json", presets.json_text(found.to_dict()))
    presets.write_text(own / "report.html", page(found, case.title))
    workflow.save_model(own / "corrected.toml", workflow.renamed(found.corrected, name), source)
    return found


def summary(name: str, found: Diagnosis) -> dict[str, Any]:
    """What the table has of a case."""
    machine = mjcf_of(found.model.robot)
    record = found.to_dict()
    return {
        "case": name,
        "title": CASES[name].title,
        "verdict": record["verdict"],
        "findings": record["findings"],
        "unexplained": [(left["location"], left["depends_on"]) for left in record["unexplained"]],
        "parameters": record["parameters"],
        "heldout": {
            state: dict(record["rmse_rad"]["validation"][state]) for state in ("nominal", "refitted", "corrected")
        },
        "units": {joint.name: "m" if joint.slides else "rad" for joint in machine.joints},
        "figures": dict(CASES[name].figures(found)),
        "published": CASES[name].published,
        "seconds": found.seconds,
    }


def tell(row: Mapping[str, Any]) -> None:
    """A case for people."""
    print(f"\n{row['title']}: {row['verdict']}, {row['seconds']:.0f} s")
    for finding in row["findings"]:
        numbers = ", ".join(
            f"{key} {e['value']:.4g} ({e['low'] or -np.inf:.4g} to {e['high'] or np.inf:.4g}) {e['unit']}"
            for key, e in finding["parameters"].items()
        )
        print(f"  {finding['effect']} at {', '.join(finding['locations'])}: {numbers}")
        if finding["equivalent"]:
            print("    or", ", ".join(f"{o['effect']} at {', '.join(o['locations'])}" for o in finding["equivalent"]))
    for where, what in row["unexplained"]:
        print(f"  unexplained at {where}: goes with {what or 'nothing that was looked for'}")
    for joint, unit in row["units"].items():
        errors = [row["heldout"][state][joint] * 1e3 for state in ("nominal", "refitted", "corrected")]
        told = " → ".join(f"{e:.3g}" for e in errors)
        print(f"  held out, {joint}: {told} m{unit} (as it came, refitted, corrected)")
    print("  numbers:", ", ".join(f"{key} {e['value']:.4g} {e['unit']}" for key, e in row["parameters"].items()))
    for key, value in row["figures"].items():
        print(f"  {key}: {value:.4g}")
    print(f"  published: {row['published']}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Diagnose some or all of the cases."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("names", nargs="*", choices=[*CASES, []], help="cases; all by default")
    parser.add_argument("--converted", type=Path, default=Path("real_machines"), help="folder that convert.py wrote")
    parser.add_argument("--output", type=Path, default=Path("real_machines_results"))
    given = parser.parse_args(arguments)
    if not given.converted.is_dir():
        raise SystemExit(f"{given.converted}: there is no such folder; write it with convert.py")
    names = given.names or list(CASES)
    for folder in (given.converted / CASES[name].recordings for name in names):
        if not folder.is_dir():
            raise SystemExit(f"{folder}: there is no such folder; write it with convert.py")
    rows = []
    for name in names:
        print(name, flush=True)
        rows.append(summary(name, diagnosed(name, given.converted, given.output)))
        tell(rows[-1])
    (given.output / "summary.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
