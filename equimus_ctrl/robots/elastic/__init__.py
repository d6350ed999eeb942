"""Planar robots driven by linear elastic actuators, described by their geometry."""
