"""What a model leaves out of a robot: where, what, how much."""
