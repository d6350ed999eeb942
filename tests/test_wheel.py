"""A wheel built from the tree, in an environment that has nothing else of it, away from the checkout."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import equimus_ctrl

ROOT = Path(__file__).resolve().parent.parent


def told(*command: Path | str, cwd: Path) -> str:
    done = subprocess.run([str(word) for word in command], cwd=cwd, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.long
@pytest.mark.slow
def test_a_wheel_works_in_a_bare_environment(tmp_path: Path) -> None:
    told(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", tmp_path, ROOT, cwd=tmp_path)
    (wheel,) = tmp_path.glob("equimus_ctrl-*.whl")
    told(sys.executable, "-m", "venv", tmp_path / "bare", cwd=tmp_path)
    programs = tmp_path / "bare" / "bin"
    told(programs / "pip", "install", "-q", "-c", ROOT / "constraints.txt", wheel, cwd=tmp_path)
    assert told(programs / "equimus-ctrl", "--version", cwd=tmp_path).split() == [
        "equimus-ctrl",
        equimus_ctrl.__version__,
    ]
    assert (
        told(programs / "python", "-m", "equimus_ctrl", "--version", cwd=tmp_path)
        == f"equimus-ctrl {equimus_ctrl.__version__}\n"
    )
    effects = json.loads(told(programs / "equimus-ctrl", "list", "effects", "--json", cwd=tmp_path))["effects"]
    assert {"dead_zone", "coulomb_friction"} <= {effect["name"] for effect in effects}
    # Scenarios come from the wheel's presets, for there are none here; nothing of the checkout or of extras is on the path.
    scenarios = json.loads(told(programs / "equimus-ctrl", "list", "scenarios", "--json", cwd=tmp_path))["scenarios"]
    assert {"hold", "triangle"} <= {scenario["name"] for scenario in scenarios}
    where = told(programs / "python", "-c", "import equimus_ctrl; print(equimus_ctrl.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(tmp_path / "bare")
