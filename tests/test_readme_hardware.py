"""The README's commands for hardware, beside its emulator, at the robot's clock."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from hardware_rig import DOMAIN, LOOPBACK
from test_readme import arguments, prepared, tour

from equimus_ctrl.cli.main import main


@pytest.mark.slow
@pytest.mark.real_time
def test_readme_commands_for_hardware_run_beside_the_emulator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepared(tmp_path, monkeypatch)
    emulate, *found = tour()[1]
    assert len(found) >= 3
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
    code = "from equimus_ctrl.cli.main import entry; entry()"
    beside = subprocess.Popen([sys.executable, "-c", code, *shlex.split(emulate)[1:-1]])
    try:
        for command in found:
            assert main(arguments(command)) == 0, command
    finally:
        beside.terminate()
        beside.wait(30)
    assert (tmp_path / "real").is_dir()
