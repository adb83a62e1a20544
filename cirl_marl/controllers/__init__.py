"""Controllers: what maps observations to actions, learnt or not."""

from cirl_marl.controllers.basic import Constant, Controller, Neutral, Random

__all__ = ["Constant", "Controller", "Neutral", "Random"]
