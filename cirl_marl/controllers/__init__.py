"""Controllers: what maps observations to actions, learnt or not."""

from cirl_marl.controllers.basic import Constant, Controller, Neutral, Random
from cirl_marl.controllers.scripted import Scripted

__all__ = ["Constant", "Controller", "Neutral", "Random", "Scripted"]
