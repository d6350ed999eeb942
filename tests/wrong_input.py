"""A folder with something wrong of every kind, and what the command may say about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import equimus_ctrl as eq
from equimus_ctrl import presets, recordings

Ran = tuple[int, str, str]
"""Exit code, standard output, standard error."""

SHORT = ("--no-figures", "--set", "duration=0.2")
RUN = ("run", "hold", *SHORT)
SCORE = ("score", "good.csv")

CONTROLLERS = """\
import numpy as np

class Fine:
    def init(self, spec, observation):
        return None
    def step(self, observation, reference, state):
        return np.array([1e4, 1e4]), state

class GivesNaN(Fine):
    def step(self, observation, reference, state):
        return np.array([np.nan, 0.0]), state

class WrongShape(Fine):
    def step(self, observation, reference, state):
        return np.zeros(3), state

class Alone(Fine):
    def step(self, observation, reference, state):
        return np.zeros(2)

class Words(Fine):
    def step(self, observation, reference, state):
        return "a lot", state

class NeedsGain(Fine):
    def __init__(self, gain):
        self.gain = gain

class Raises(Fine):
    def step(self, observation, reference, state):
        raise ValueError("boom")

class RaisesAtOnce(Fine):
    def init(self, spec, observation):
        raise ValueError("boom")

class OldStyle(Fine):
    def init(self, spec):
        return None

class Idle:
    pass

def one(observation):
    return np.zeros(2)

number = 3
"""

STUDY: dict[str, Any] = {
    "candidates": 2,
    "objectives": [{"scenario": "hold", "duration": 2.5}],
    "ensemble": {"members": 2, "unseen": 0},
    "search": {
        "kp": {"low": 5.0, "high": 3000.0, "start": 150.0},
        "ki": {"low": 5.0, "high": 5000.0, "start": 200.0},
        "kd": {"low": 0.2, "high": 200.0, "start": 5.0},
        "derivative_time": {"low": 0.005, "high": 0.1, "start": 0.02},
    },
}


def study(**changes: Any) -> str:
    """The small study with some tables changed, a table's keys one by one."""
    data = {
        key: {**STUDY[key], **value} if isinstance(STUDY.get(key), dict) and isinstance(value, dict) else value
        for key, value in {**STUDY, **changes}.items()
    }
    return presets.toml_text(data)


FILES = {
    "mine.py": CONTROLLERS,
    "broken.py": "import no_such_module\n",
    "syntax.py": "def (:\n",
    "no_build.py": "x = 1\n",
    "bad.toml": "a = [\n",
    "latin.toml": b'a = "\xe9"\n',
    "fast.toml": '[parameters]\n"thigh.mass" = 1e-9\n"maa.stiffness" = 1e9\n',
    "header.csv": "a,b\n1,2\n",
    "empty.csv": "",
    "empty.toml": "# nothing yet\n",
    "gap.csv": "time,cmd.maa,cmd.baa,pos.hip,pos.knee\n0,0,0,1.5,0\n0.1,0,0,nan,0\n",
    "back.csv": "time,cmd.maa,cmd.baa,pos.hip,pos.knee\n0,0,0,1.5,0\n-0.1,0,0,1.5,0\n",
    "degrees.csv": "time,cmd.maa,cmd.baa,pos.hip,pos.knee\n0,0,0,90,0\n0.1,0,0,90,0\n",
    "high.csv": "time,cmd.maa,cmd.baa,pos.hip,pos.knee\n0,0,60000,1.5,0\n0.1,0,0,1.5,0\n",
    "lame.csv": "time,cmd.maa,cmd.baa,pos.hip\n0,0,0,1.5\n0.1,0,0,1.5\n",
    "recordings/triangle.csv": "a,b\n1,2\n",
    "plain_file": "",
}


def fill(folder: Path) -> None:
    """All of ``FILES``, an empty folder and a recording that is right."""
    for name, content in FILES.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    (folder / "nothing").mkdir()
    pose = eq.Kinematics(eq.nominal_leg()).equilibrium([12e3, 6e3])
    trial = eq.Recording(
        "good",
        np.arange(30) / 60,
        np.tile([12e3, 6e3], (30, 1)),
        np.tile(pose, (30, 1)),
        ("maa", "baa"),
        ("hip", "knee"),
    )
    recordings.write(folder / "good.csv", trial)


def snapshot(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b""
        for path in folder.rglob("*")
        if "__pycache__" not in path.parts
    }


def sentence(ran: Ran, code: int) -> str:
    """The one line that says what is wrong; a progress bar may stand before it."""
    assert ran[0] == code, ran[2]
    said = [line for line in ran[2].splitlines() if line.startswith("equimus-ctrl: ")]
    assert len(said) == 1, ran[2]
    rest = [line for line in ran[2].splitlines() if line.strip() and line != said[0] and "left" not in line]
    assert rest == [], "there is more on standard error than the sentence"
    assert ran[2].rstrip("\n").endswith(said[0])
    return said[0].removeprefix("equimus-ctrl: ")
