"""Experiments that distinguish what recordings could not: explanations compared on trials that nobody has made yet."""
