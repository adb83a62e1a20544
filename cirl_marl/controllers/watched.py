"""How far a controller is, in its plans and in its episode."""

from __future__ import annotations

from collections.abc import Callable

from cirl_marl.controllers.basic import Arrays, Controller, Planner
from cirl_marl.environments.vector import VectorEnv


class Watched(Controller):
    """A controller that tells how far its episode is: its plans, if it is a planner, and what it has carried out.

    >>> from cirl_marl.controllers import Neutral
    >>> from cirl_marl.controllers.rollout import rollout
    >>> shares = []
    >>> watched = Watched(Neutral(), shares.append)
    >>> _ = rollout(VectorEnv("net_zero", num_envs=1, horizon=2), watched, progress=watched.acted)
    >>> shares
    [0.5, 1.0]
    """

    def __init__(self, controller: Controller, progress: Callable[[float], None]) -> None:
        """Take who acts, and what is called with the share of the episode's work that is done."""
        self._controller, self._progress = controller, progress
        self._ahead, self._steps = 0.0, 1

    def start(self, env: VectorEnv, seed: int) -> None:
        """Start the controller, and tell how far its plans are."""
        self._ahead, self._steps = 0.0, env.network.episode.horizon
        if isinstance(self._controller, Planner):
            ahead = self._ahead = self._controller.ahead
            self._controller.plan(env, seed, lambda share: self._progress(ahead * share))
        else:
            self._controller.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return the controller's actions."""
        return self._controller.act(observations)

    def acted(self, intervals: int) -> None:
        """Tell that so many intervals are done; ``rollout`` takes this as its ``progress``."""
        self._progress(self._ahead + (1.0 - self._ahead) * intervals / self._steps)
