"""Blinded ground truths: legs with known missing physics, for putting the diagnosis to the proof."""
