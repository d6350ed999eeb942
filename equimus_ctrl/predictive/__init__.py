"""Optimal control over a horizon: transcription, quadratic programs, sequential quadratic programming."""
