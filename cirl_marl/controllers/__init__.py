"""Who acts by rule (neutral, constant, random, scripted, linear-quadratic), and the episodes that come of it."""

from cirl_marl.controllers.basic import Constant, Controller, Neutral, Planner, Random
from cirl_marl.controllers.lqr import LQR, LinearSystem
from cirl_marl.controllers.scripted import ScriptController

__all__ = ["LQR", "Constant", "Controller", "LinearSystem", "Neutral", "Planner", "Random", "ScriptController"]
