"""Controllers that need no learning: neutral, constant and random."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import ControlError, unknown_name

Arrays = Mapping[str, NDArray[np.floating]]


class Controller(ABC):
    """Maps the observations of all agents to their actions."""

    note: str = ""
    """Once started, what is to be said beside its figures; empty if nothing is."""

    @abstractmethod
    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Get ready to act in ``env``, once before an evaluation; random controllers draw from ``seed`` only."""

    @abstractmethod
    def act(self, observations: Arrays) -> Arrays:
        """Return agent → actions (B, entries of its action) in [−1, 1], given agent → observations (B, k)."""


class Planner(Controller):
    """A controller that plans when it is started, for so long that it tells how far it is."""

    ahead: float
    """About what share of the work of an episode is done before it begins."""

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Plan without telling how far it is."""
        self.plan(env, seed, lambda share: None)

    @abstractmethod
    def plan(self, env: MultiAgentVectorEnv, seed: int, progress: Callable[[float], None]) -> None:
        """Do what ``start`` does; ``progress`` is called with the share of it that is done."""


class Constant(Controller):
    """Holds fixed normalised actions, the same for each entry of an action; agents that are not named stay neutral."""

    def __init__(self, actions: Mapping[str, float] | None = None) -> None:
        """Hold ``actions``, agent → value in [−1, 1]."""
        self._constants = dict(actions or {})
        self._actions: dict[str, NDArray[np.floating]] = {}

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Take the actions of ``env``'s agents; an agent that does not act or a value out of bounds is refused."""
        for agent, value in self._constants.items():
            if agent not in env.agents:
                raise ControlError(f"constant control: {unknown_name('agent', agent, env.agents)}")
            if not -1.0 <= value <= 1.0:
                raise ControlError(f"constant control of '{agent}' is {value}; it must lie in [-1, 1]")
        self._env = env
        self._actions = {
            a: np.full_like(n, self._constants[a]) for a, n in env.neutral_action.items() if a in self._constants
        }
        for action in self._actions.values():
            action.flags.writeable = False

    def act(self, observations: Arrays) -> Arrays:
        """Return the fixed actions, whose arrays are read-only, and neutral ones of the coming interval."""
        return self._env.neutral_beside(self._actions)


class Neutral(Constant):
    """Leaves every agent at its neutral control."""

    def __init__(self) -> None:
        """Hold nothing."""
        super().__init__()


class Random(Controller):
    """Draws every action uniformly and independently."""

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Seed the draws."""
        self._shapes = {agent: neutral.shape for agent, neutral in env.neutral_action.items()}
        self._random = np.random.default_rng([seed, 1])  # not the numbers that the start states are drawn from

    def act(self, observations: Arrays) -> Arrays:
        """Return fresh random actions."""
        del observations
        return {agent: self._random.uniform(-1.0, 1.0, shape) for agent, shape in self._shapes.items()}
