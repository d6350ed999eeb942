"""A robot's end of the wire played by the simulated leg, in real time, with the faults of real ones to order."""
