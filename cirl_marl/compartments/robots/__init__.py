"""Robots in MuJoCo: the state of the simulator is part of the state of the model."""
