"""Physics that can be attached to a model."""

from equimus_ctrl.effects.base import REGISTRY, Effect, make, parse
from equimus_ctrl.effects.valves import AsymmetricLag, FirstOrderLag, TransportDelay

__all__ = ["REGISTRY", "AsymmetricLag", "Effect", "FirstOrderLag", "TransportDelay", "make", "parse"]
