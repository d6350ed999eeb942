"""Control, simulation and diagnosis of robots driven by linear elastic actuators.

``import equimus_ctrl as eq`` is enough to build a plant, write a controller, run a scenario with it and score it.
"""

import lazy_loader as _lazy

__version__ = "0.1.0"

# Imported on first use: the command line answers --help without loading MuJoCo, CasADi and numba.
__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
