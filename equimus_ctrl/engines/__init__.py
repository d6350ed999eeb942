"""Engines predict joint angles for given commands, parameters and effects: reduced (compiled) and MuJoCo."""
