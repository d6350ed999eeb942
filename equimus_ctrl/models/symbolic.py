"""The equations of motion of every robot from one source.

    M(q) a + h(q, v) = J(q)ᵀ f + tau

with joint coordinates q, rates v, drive forces f (positive where they lengthen an actuator) and joint torques
tau. Rigid-body mechanics are those of ``models.tree``; what a kind of robot adds is in ``models.elastic_equations`` and
``models.mjcf_equations``.
"""

from __future__ import annotations

from functools import cache

from equimus_ctrl.models.elastic_equations import elastic_equations
from equimus_ctrl.models.mjcf_equations import mjcf_equations
from equimus_ctrl.models.symbolic_model import SymbolicModel
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, structure
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.robots.mjcf.form import TreeForm


def symbolic_model(morphology: Morphology, phase: Phase = "swing") -> SymbolicModel:
    """The equations of motion of a robot; parameters stay symbols (``SymbolicModel.p``).

    Args:
        morphology: the robot.
        phase: base fixed or foot pinned.
    """
    return build(structure(morphology), phase)


@cache
def build(form: Structure, phase: Phase) -> SymbolicModel:
    """The equations of motion of a structure; a phase other than swing is one of elastic robots.

    All are kept: what is made from one shares its symbols.
    """
    return mjcf_equations(form) if isinstance(form, TreeForm) else elastic_equations(form, phase)
