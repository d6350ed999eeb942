"""Experiments that tell rival explanations apart: designed within limits, run, diagnosed."""
