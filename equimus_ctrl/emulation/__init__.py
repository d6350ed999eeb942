"""A robot's end of the wire played by a simulated robot, in real time, with the faults of real ones to order."""
