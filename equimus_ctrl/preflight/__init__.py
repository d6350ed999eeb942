"""What recordings could show, before anything is fitted: signals, delays, repeats, and which parameters and effects.

``signals`` and ``latency`` ask one recording at a time, ``runs`` several, ``information`` the model. ``judgement``
makes
sentences of what they found, by the thresholds of ``limits``; ``result.Check`` holds all of it.
"""
