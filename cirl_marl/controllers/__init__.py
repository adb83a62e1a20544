"""Controllers: what maps observations to actions, learnt or not.

``controllers.mpc`` and ``controllers.trained`` are imported by name: the one stands on ``optimum``, which evaluates
controllers itself, the other loads torch.
"""

from cirl_marl.controllers.basic import Constant, Controller, Neutral, Random
from cirl_marl.controllers.lqr import LQR, LinearSystem
from cirl_marl.controllers.scripted import Scripted

__all__ = ["LQR", "Constant", "Controller", "LinearSystem", "Neutral", "Random", "Scripted"]
