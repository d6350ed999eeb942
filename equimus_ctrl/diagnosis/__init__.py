"""Missing physics of a model: where, which effect, how large."""
