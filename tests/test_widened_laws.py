"""A law that is found at some joints is fitted at all of them from there, where one more at a time would seem better."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from equimus_ctrl.diagnosis.candidates import location_groups
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, default_free_parameters
from equimus_ctrl.diagnosis.wider_laws import wider
from equimus_ctrl.effects import REGISTRY
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

LINK = '<body name="l{0}" pos="0 0 -0.3"><joint name="j{0}" axis="0 1 0"/><geom type="sphere" size=".03" mass="1"/>{1}</body>'
JOINTS = ("j1", "j2", "j3")


def chain() -> Model:
    inner = ""
    for k in (3, 2, 1):
        inner = LINK.format(k, inner)
    motors = "".join(f'<motor name="m{k}" joint="j{k}"/>' for k in (1, 2, 3))
    xml = f'<mujoco model="chain"><worldbody>{inner}</worldbody><actuator>{motors}</actuator></mujoco>'
    return Model(MjcfRobot("chain", xml, source="chain.xml"))


def widened(*parts: Part, pool: list[Candidate]) -> Any:
    free = default_free_parameters(chain())
    data = Data(free, (), None)  # type: ignore[arg-type]
    values = [value for part in parts for value in part.values.values()]
    fit: Any = SimpleNamespace(theta=np.array([*free.start, *values]), starts=())
    return list(wider(data, Fitted(parts, fit, (), 0.0), pool))


@pytest.mark.parametrize("places", [("j2",), ("j1",)])
def test_a_law_at_one_joint_is_begun_at_all_from_its_size_there(places: tuple[str, ...]) -> None:
    effect = REGISTRY["coulomb_friction"]
    assert JOINTS in location_groups(effect, chain().robot)
    wide = Candidate(effect, JOINTS, ({f"{j}.friction": 0.3 for j in JOINTS},), each=True)
    part = Part(Candidate(effect, places, ({"friction": 0.3},)), {"friction": 0.07})
    other = Part(Candidate(REGISTRY["sensor_offset"], ("j1",), ({"offset": 0.1},)), {"offset": 0.02})
    ((hypothesis, ((theta, _),)),) = widened(other, part, pool=[wide])
    assert [p.candidate.label for p in hypothesis] == [other.candidate.label, wide.label]
    assert hypothesis[1].values == {f"{j}.friction": 0.07 if j in places else 0.3 for j in JOINTS}
    assert theta[-4:] == pytest.approx([0.02, *hypothesis[1].values.values()])


def test_nothing_is_widened_to_a_single_joint_more() -> None:
    effect = REGISTRY["coulomb_friction"]
    wide = Candidate(effect, JOINTS, ({f"{j}.friction": 0.3 for j in JOINTS},), each=True)
    two = wide.narrowed(("j1", "j2"))
    assert widened(Part(two, {"j1.friction": 0.1, "j2.friction": 0.2}), pool=[wide]) == []
    alike = Part(Candidate(effect, JOINTS, ({"friction": 0.3},)), {"friction": 0.1})
    assert widened(alike, pool=[wide]) == []
