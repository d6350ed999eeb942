"""What the commands do, as functions of a library: load a model, run a scenario, score, tune, identify."""

import lazy_loader as _lazy

# Imported on first use: a verb loads what it needs, a diagnosis neither tuning nor proofs.
__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
