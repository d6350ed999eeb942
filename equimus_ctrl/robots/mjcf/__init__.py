"""Robots that MuJoCo's own XML describes."""
