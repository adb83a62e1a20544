"""An environment at present: what may be known to who acts in it, and nothing of what is still to come."""

from __future__ import annotations

from cirl_marl.environments.starts import Starts
from cirl_marl.environments.vector import MultiAgentVectorEnv


class PresentEnv(MultiAgentVectorEnv):
    """A copy of an environment that knows what disturbances were and are, not what they will be.

    Its random streams are others, so that nobody sees the future by going ahead in it, or by starting it again.
    """

    def __init__(self, env: MultiAgentVectorEnv) -> None:
        """Copy an environment that was reset."""
        self.__dict__.update(env.__dict__)
        self._starts = Starts(self.network, self.dynamics, self.num_envs, self.layout.array_order)
        self.follow(env)

    def follow(self, env: MultiAgentVectorEnv) -> None:
        """Go to where the environment is by now."""
        self._state, self.episodes, self.controls = env.physical.without_future(), env.episodes, env.controls
