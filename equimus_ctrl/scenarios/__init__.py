"""Scenarios: references, what a run is scored against, and how."""
