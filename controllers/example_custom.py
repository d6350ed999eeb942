"""A controller of your own, in two forms. Copy this file and edit it.

equimus-ctrl run hold --controller controllers/example_custom.py:Spring
equimus-ctrl run hold --controller controllers/example_custom.py:spring
"""

import numpy as np

import equimus_ctrl as eq


class Spring:
    """Static pressures of the reference pose, plus a spring on each actuator's length.

    ``init`` returns what evolves, ``step`` takes and returns it; here nothing evolves but the geometry is kept.
    """

    stiffness = 300.0  # N per metre of missing length

    def init(self, spec, observation):
        return eq.Kinematics(spec.model, spec.phase)

    def step(self, observation, reference, kinematics):
        wanted = reference.position(observation.time)
        missing = kinematics.lengths(wanted) - kinematics.lengths(observation.position)
        area = np.array([actuator.area for actuator in kinematics.morphology.actuators])
        return kinematics.static_pressure(wanted) + self.stiffness * missing / area, kinematics


def spring(observation, reference, spec):
    """The same as a function: no state, pressures in Pa out; they are clipped to the plant's range."""
    return Spring().step(observation, reference, eq.Kinematics(spec.model, spec.phase))[0]


if __name__ == "__main__":
    done = eq.run_scenario("hold", Spring)
    print("RMSE [rad]:", done.score.tracking.rmse)
