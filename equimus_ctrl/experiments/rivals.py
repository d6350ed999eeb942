"""Rivals: the explanations between which experiments are to decide, see ``diagnosis.rivals``."""

from __future__ import annotations

from equimus_ctrl.diagnosis.rivals import Missing as Missing
from equimus_ctrl.diagnosis.rivals import Rival as Rival
from equimus_ctrl.diagnosis.rivals import Rivals as Rivals
