"""Truths and reports of a proof, made by hand."""

from __future__ import annotations

import math
from typing import Any

from equimus_ctrl.proof.scoring import Score, score
from equimus_ctrl.robots.elastic.leg import nominal_leg

OWN = {"maa.stiffness": 250.0, "knee.damping": 0.05}
NOISE = {"hip": 2e-3, "knee": 1e-3}


def effect(name: str, *locations: str, alone: float = 10.0, **parameters: float) -> dict[str, Any]:
    return {"effect": name, "locations": list(locations), "parameters": parameters, "alone": alone}


def truth(kind: str, *found: dict[str, Any], excess: float = 10.0, coloured: bool = False) -> dict[str, Any]:
    outside = [{key: e[key] for key in ("effect", "locations", "parameters")} for e in found]
    return {
        "case": 0,
        "kind": kind,
        "findings": list(found) if kind in ("single", "pair") else [],
        "outside": outside if kind == "outside" else [],
        "excess": excess if kind != "none" else 0.0,
        "noise_rad": NOISE,
        "noise_correlation_s": 0.02 if coloured else 0.0,
        "parameters": OWN,
    }


def finding(name: str, *locations: str, equivalent: tuple[Any, ...] = (), **values: float) -> dict[str, Any]:
    """With intervals of ± 10 %."""
    numbers = {k: {"value": v, "low": v - 0.1 * abs(v), "high": v + 0.1 * abs(v)} for k, v in values.items()}
    others = [{"effect": e, "locations": list(where)} for e, *where in equivalent]
    return {"effect": name, "locations": list(locations), "parameters": numbers, "equivalent": others}


def left(location: str, *acts_at: str) -> dict[str, Any]:
    return {"location": location, "acts_at": list(acts_at), "share": 1.0}


def report(*findings: dict[str, Any], unexplained: tuple[dict[str, Any], ...] = (), seconds: float = 10.0) -> Any:
    refitted = {"hip": NOISE["hip"] * math.sqrt(5), "knee": NOISE["knee"] * math.sqrt(3)}
    corrected = {"hip": NOISE["hip"] * math.sqrt(1.2), "knee": NOISE["knee"] * math.sqrt(1.4)}
    return {
        "verdict": "explained" if findings else "unexplained" if unexplained else "consistent",
        "findings": list(findings),
        "unexplained": list(unexplained),
        "parameters": {name: {"value": v, "low": 0.9 * v, "high": 1.1 * v} for name, v in OWN.items()},
        "trials": {"test": ["t7"]},
        "rmse_rad": {"test": {"refitted": refitted, "corrected": corrected}},
        "proof": {"failed": "", "seconds": seconds, "cpu_seconds": seconds, "peak_memory_byte": 3 * 10**8},
    }


def scored(*pairs: tuple[dict[str, Any], Any], others: list[dict[str, Any]] | None = None) -> Score:
    truths = [{**t, "case": k} for k, (t, _) in enumerate(pairs)]
    return score(truths, [r for _, r in pairs], others or [{} for _ in pairs], nominal_leg())


LAG = effect("first_order_lag", "maa", time_constant=0.2)
RUB = effect("coulomb_friction", "knee", friction=0.02)
SAID_LAG = finding("first_order_lag", "maa", time_constant=0.21)
SAID_RUB = finding("coulomb_friction", "knee", friction=0.021)
