"""Cases of wrong input for the whole command: verbs, with files that were right and options that are not."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

import foreign_logs
import numpy as np
import typer
from fuzz_inputs import changed, flipped, odd_number, odd_path, odd_text, odd_word
from wrong_input import study

import equimus_ctrl as eq
from equimus_ctrl import recordings
from equimus_ctrl.cli.main import app

ROOT = Path(__file__).resolve().parents[1]
JOINT, ACTUATORS = ("hinge",), ("motor",)


@dataclass(frozen=True)
class Case:
    """One call of the command.

    Attributes:
        name: by which it can be made again.
        arguments: of the command.
        files: path → what is in it, in the folder where it is called.
        outputs: paths in the arguments where something may be written.
    """

    name: str
    arguments: tuple[str, ...]
    files: dict[str, bytes]
    outputs: tuple[str, ...] = field(default=())


def right_files(folder: Path) -> dict[str, bytes]:
    """Small files of each kind that are right, by path."""
    folder.mkdir()
    wave = np.sin(np.arange(30) / 5)[:, None]
    clock = np.arange(30) / 60
    slow, long = np.arange(90) / 60, np.sin(np.arange(90) / 5)[:, None]
    leg = eq.Recording("leg", clock, 12e3 + 3e3 * np.hstack([wave, -wave]), 1.3 + 0.1 * np.hstack([wave, wave]),
                       ("maa", "baa"), ("hip", "knee"), notes={"author": "somebody"})  # fmt: skip
    pendulum = eq.Recording("pendulum", slow, long, 0.1 * long, ACTUATORS, JOINT, notes={"settled": "no"})
    arm = eq.Recording("arm", foreign_logs.TIMES[:40], foreign_logs.goals(foreign_logs.TIMES)[:40],
                       foreign_logs.motion(foreign_logs.TIMES)[:40], foreign_logs.ACTUATORS, foreign_logs.JOINTS)  # fmt: skip
    (folder / "legs").mkdir()
    for name, trial in (("legs/leg.csv", leg), ("pendulum.csv", pendulum), ("arm.csv", arm)):
        recordings.write(folder / name, trial)
    for suffix in ("npz", "parquet", "mcap"):
        eq.write_recording(folder / f"arm.{suffix}", arm)
    short = list(
        zip(
            foreign_logs.TIMES,
            foreign_logs.motion(foreign_logs.TIMES),
            foreign_logs.goals(foreign_logs.TIMES),
            strict=True,
        )
    )[:30]
    messages = [foreign_logs.joint_state("/joint_states", t, foreign_logs.JOINTS, q) for t, q, _ in short]
    messages += [foreign_logs.array("/forward_position_controller/commands", t, u) for t, _, u in short]
    foreign_logs.write_bag(folder / "bag", messages)
    foreign_logs.write_lerobot(folder / "set")
    foreign_logs.write_bam(folder / "bam.json")
    foreign_logs.write_torch(folder / "pace.pt", {"time": clock, "dof_pos": wave, "des_dof_pos": wave})
    foreign_logs.write_json_mcap(folder / "json.mcap", {
        "/joints": ("sensor_msgs/JointState", [(float(t), {"name": list(foreign_logs.JOINTS), "position": q.tolist()}) for t, q, _ in short]),
        "/goals": ("std_msgs/Float64MultiArray", [(float(t), {"data": u.tolist()}) for t, _, u in short]),
    })  # fmt: skip
    texts = {
        "arm.xml": foreign_logs.XML,
        "one.xml": foreign_logs.ONE.robot.xml,
        "robot.toml": 'mjcf = "pendulum.xml"\n[parameters]\n"arm.mass" = 0.7\n[[effects]]\neffect = "coulomb_friction"\n'
        'location = "hinge"\nfriction = 0.02\n',
        "map.toml": 'format = "equimus-ctrl/mapping/1"\n[units]\npos = "deg"\ncmd = "deg"\n'
        '[names]\npos = ["shoulder", "elbow"]\ncmd = ["m1", "m2"]\n',
        "study.toml": study(),
        "free.toml": 'format = "equimus-ctrl/parameters/1"\n[free]\n"arm.mass" = [0.4, 0.8]\n"hinge.damping" = true\n',
        "slurm.toml": 'partition = "cpu"\ntime = 60\ncpus_per_task = 2\n',
        "plugin.py": (ROOT / "docs/examples/drag.py").read_text(),
        "syntax.py": "def (:\n",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    for path in ("docs/examples/pendulum.xml", "docs/examples/heavy_leg.toml", "docs/examples/finger.toml",
                 "docs/examples/pendulum_hardware.toml", "tuning/leg.toml", "tuning/any.toml", "hardware/equimus_leg.toml",
                 *(f"controllers/{name}.toml" for name in ("pid", "lqr", "nmpc", "sampling"))):  # fmt: skip
        shutil.copy(ROOT / path, folder)
    for name in ("nmpc", "sampling"):  # a compiler takes its time
        text = (folder / f"{name}.toml").read_text()
        (folder / f"{name}.toml").write_text(text.replace("compiled = true", "compiled = false"))
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


BRIEF = "--set duration=0.1 --no-figures"
ARM_LOGS = ["arm.csv", "arm.npz", "arm.parquet", "arm.mcap", "json.mcap", "bag", "set"]
CALLS: dict[str, tuple[tuple[str, ...], ...]] = {
    f"run hold --model pendulum.xml {BRIEF}": (("pendulum.xml",),) * 4,
    f"run hold --model robot.toml {BRIEF}": (("robot.toml",), ("robot.toml",), ("pendulum.xml",)),
    f"run hold --model heavy_leg.toml {BRIEF}": (("heavy_leg.toml",),) * 2,
    f"run chirp --model finger.toml {BRIEF} -c open_loop": (("finger.toml",),) * 2,
    f"run hold {BRIEF} -c pid --settings pid.toml": (("pid.toml",),) * 2,
    f"run hold --model pendulum.xml {BRIEF} -c lqr --settings lqr.toml": (("lqr.toml",),) * 2,
    f"run hold --model pendulum.xml {BRIEF} -c nmpc --settings nmpc.toml": (("nmpc.toml",),) * 2,
    f"run hold --model pendulum.xml {BRIEF} -c sampling --settings sampling.toml": (("sampling.toml",),) * 2,
    f"run multisine {BRIEF}": ((),),
    f"run step --model pendulum.xml {BRIEF} --set begins=0.02": ((),),
    f"run hold --plant hardware --hardware equimus_leg.toml {BRIEF}": (("equimus_leg.toml",),) * 2,
    f"run hold --plugin plugin.py {BRIEF}": ((),),
    "list parameters --model pendulum.xml --json": (("pendulum.xml",),) * 3,
    "list parameters --model heavy_leg.toml": (("heavy_leg.toml",),),
    "list effects": ((),),
    "export pendulum.xml -o out.xml": (("pendulum.xml",),),
    "export robot.toml -o out.xml --json": (("robot.toml",),),
    "export heavy_leg.toml -o out.xml --leave-out asymmetric_lag": (("heavy_leg.toml",),),
    "score legs/leg.csv --json": (("legs/leg.csv",),) * 3,
    "score pendulum.csv --model pendulum.xml --json": (("pendulum.csv",),) * 3,
    "score pendulum.csv --model robot.toml": (("robot.toml",),),
    "score arm.csv --model arm.xml": (("arm.xml",),),
    **{f"score {log} --model arm.xml --map map.toml --json": ((log,), (log,), ("map.toml",)) for log in ARM_LOGS},
    **{f"recordings check {log} --model arm.xml --map map.toml": ((log,),) for log in ARM_LOGS},
    "score bam.json --model one.xml": (("bam.json",), ("one.xml",)),
    "recordings check pace.pt --model pendulum.xml": (("pace.pt",),),
    "recordings check legs": (("legs/leg.csv",),),
    "recordings import bag set --model arm.xml --map map.toml -o new": (("bag",), ("set",), ("map.toml",)),
    "recordings import legs/leg.csv -o new": (("legs/leg.csv",),),
    "recordings import-bag bag -o new --model arm.xml": (("bag",),),
    "recordings export pendulum.csv --model pendulum.xml -o out.mcap": (("pendulum.csv",),),
    "recordings fetch -o folder": ((),),
    "check legs --quick": (("legs/leg.csv",),),
    "check pendulum.csv --model pendulum.xml --budget 1 --parameters free.toml": (("free.toml",), ("pendulum.csv",)),
    "identify pendulum.csv --model pendulum.xml --no-figures --parameters free.toml": (
        ("free.toml",),
        ("pendulum.csv",),
    ),
    "sensitivity pendulum.csv --model pendulum.xml --no-figures": (("pendulum.csv",),),
    "diagnose legs": (("legs/leg.csv",),),
    "diagnose pendulum.csv --model pendulum.xml --parameters free.toml": (("free.toml",), ("pendulum.csv",)),
    f"compare hold --model pendulum.xml -c pid --condition nominal {BRIEF}": (("pendulum.xml",),),
    "autotune-pid --study study.toml --no-figures": (("study.toml",),) * 3,
    "autotune lqr --study leg.toml --no-figures": (("leg.toml",),) * 2,
    "autotune lqr --model pendulum.xml --study any.toml": (("any.toml",), ("pendulum.xml",)),
    "prove --cases 2": ((),),
    "prove pendulum.csv --model pendulum.xml --cases 2": (("pendulum.csv",),),
    "prove --cases 2 --slurm slurm.toml": (("slurm.toml",),) * 2,
    "validate --quick": ((),),
    "emulate --hardware equimus_leg.toml": (("equimus_leg.toml",),),
    "emulate --model pendulum.xml --hardware pendulum_hardware.toml": (("pendulum_hardware.toml",),),
    "hardware check --hardware equimus_leg.toml": (("equimus_leg.toml",),),
    "hardware delay --arm --model pendulum.xml --hardware pendulum_hardware.toml": (("pendulum_hardware.toml",),),
}
"""Calls of which all is right → what may be changed, each time one of these: files, or folders of them."""
WRITES = {
    "--output", "-o", "--record", "--results", "--report", "--figure", "--write", "--write-model", "--log", "--video",
}  # fmt: skip
CALM = {"--workers": "1", "--threads": "1"}
"""Options that would start more processes or threads than a test may."""
OF_MODELS = ("--lock", "--ignore", "--motors", "--prescribe", "--unmeasured")
"""Which many verbs have."""
LEFT_OUT = ("--help", "--install-completion", "--show-completion", "--scheduler", "--arm")


def options_of(words: list[str]) -> dict[str, Any]:
    """Flag → parameter of all options of a verb."""
    command: Any = typer.main.get_command(app)
    for word in words:
        command = getattr(command, "commands", {}).get(word, command)
    return {p.opts[0]: p for p in command.params if p.opts[0].startswith("--") and p.opts[0] not in LEFT_OUT}


def unchanged(right: dict[str, bytes]) -> Iterator[Case]:
    """Each call as it is."""
    for call in CALLS:
        words = call.split(" ")
        yield Case(call, tuple(words), right, tuple(_written(words)))


def case(seed: int, k: int, right: dict[str, bytes]) -> Case:
    """One of the cases of a seed; it depends on both numbers and the files alone."""
    random = Random(f"{seed}/{k}")
    call = list(CALLS)[k % len(CALLS)]
    words, files = call.split(" "), dict(right)
    damaged = random.choice(CALLS[call])
    kind = random.random()
    if damaged and kind < 0.7:
        for name in damaged:
            _damage(files, name, random)
    if not damaged or kind > 0.6:
        words = _with_odd_options(words, random)
    return Case(f"{seed}/{k}", tuple(words), files, tuple(_written(words)))


def _damage(files: dict[str, bytes], name: str, random: Random) -> None:
    """Change a file, or one of those in a folder, or take it away."""
    own = [path for path in files if path == name or path.startswith(name + "/")]
    path = random.choice(own)
    if random.random() < 0.05:
        files[path] = random.choice(
            (b"", b"\x00" * 100, b"\xff\xfe", b"PK\x03\x04", b"PAR1", b"\x89MCAP0\r\n", b"{}", b"[1", b"\n" * 50)
        )
        return
    try:
        text = files[path].decode()
    except UnicodeDecodeError:
        files[path] = flipped(files[path], random)
    else:
        files[path] = changed(text, random).encode("utf-8", "surrogateescape")


def _with_odd_options(words: list[str], random: Random) -> list[str]:
    """The call with one to three options that are odd, or an argument in the place of which something odd stands."""
    known = options_of(words)
    words = list(words)
    for _ in range(random.choice((1, 1, 2, 3))):
        if random.random() < 0.15:
            at = random.randrange(1, len(words))
            words[at] = odd_word(random) if random.random() < 0.7 else words[random.randrange(len(words))]
            continue
        flag = random.choice([flag for flag in known if flag not in OF_MODELS or random.random() < 0.2] or list(known))
        given = CALM.get(flag) if random.random() < 0.5 else None
        words += [flag, *([given] if given else _values(known[flag], random))]
    return words


def _values(option: Any, random: Random) -> list[str]:
    if option.is_flag:
        return []
    kind = str(option.type_descriptor.annotation).lower()
    odd = odd_path if "path" in kind else odd_number if "int" in kind or "float" in kind else odd_text
    if random.random() < 0.2:
        odd = odd_word
    if option.metavar and "=" in option.metavar and random.random() < 0.8:
        names = (
            "duration",
            "hip",
            "knee",
            "hinge",
            "keyframe",
            "size",
            "low",
            "high",
            "arm.mass",
            "maa.stiffness",
            "pid",
            odd_text(random),
        )
        if ":" in option.metavar:
            return [f"{random.choice(('coulomb_friction', 'transport_delay', 'payload_mass', 'dead_zone', odd_text(random)))}:"
                    f"{random.choice(('hip', 'baa', 'hinge', 'motor', 'arm', odd_text(random)))}:"
                    f"{random.choice(('friction', 'delay', 'mass', 'threshold', odd_text(random)))}={odd_number(random)}"]  # fmt: skip
        pair = f",{odd_number(random)}" if "," in option.metavar else ""
        return [f"{random.choice(names)}={odd_number(random)}{pair}"]
    return [odd(random) for _ in range(option.nargs)]


def _written(words: list[str]) -> Iterator[str]:
    yield from ("results", "tuning", "identification", "proof", "controllers", "nominal_leg.xml", "slurm-spool")
    for flag, value in pairwise(words):
        if flag in WRITES:
            yield value
            yield os.path.splitext(value)[0]
    if words[0] == "export":
        yield from ("pendulum.xml", "heavy_leg.xml")
    if words[0] == "prove":
        yield from (word for word in words[1:] if not word.startswith("-"))
