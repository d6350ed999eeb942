"""Rivals of legs and arms, from diagnoses made by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np

from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array


def with_other(diagnosis: Diagnosis) -> Diagnosis:
    """The same where the model without any effect fits as well as what was found."""
    return replace(diagnosis, explanations=(diagnosis.base,))


@cache
def rivals_of(diagnosis: Diagnosis) -> Rivals:
    return Rivals.of(with_other(diagnosis))


def read_back(rivals: Rivals, model: Model | None = None) -> Rivals:
    """As a record has them."""
    return Rivals.from_dict(json.loads(json.dumps(rivals.to_dict())), model or rivals.model)


def steps(seed: int = 0, duration: float = 3.0) -> Commands:
    """Pressures of a leg that jump every 0.6 s."""
    rng = np.random.default_rng(seed)
    levels = rng.uniform([2e3, 0.0], [30e3, 15e3], (5, 2))
    return Commands(0.6 * np.arange(5), levels, duration)


def spread_out(information: Array) -> Array:
    """The same with all of its directions known."""
    return information + np.eye(len(information)) * np.trace(information)
