"""Rewards as vectors, one entry for each aim, in the interface of MOMAland and MO-Gymnasium.

No aim is weighed against another: λ, the level of each service, and minus what is booked on each account. Wrappers that
make rewards linear, or learners that look for a front, do the weighing.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from cirl_marl.environments.parallel import NetworkParallelEnv
from cirl_marl.network import Network
from cirl_marl.network.elements import CIRCULARITY


class MOParallelEnv(NetworkParallelEnv):
    """One copy of a material network that pays all agents the same vector in each interval.

    Its entries, named in ``reward_names``, are the mean of λ over the interval, mass; the level of each service; and
    minus the amount on each account, discounted, in its unit. Over an episode they add up to horizon·λ̄, horizon·levels,
    and minus the totals.

    Attributes:
        reward_names: what each entry of a reward is.
        reward_spaces: by agent.
    """

    def __init__(self, network: str | Path | Network, **options: Any) -> None:
        """Make the environment; ``options`` are those of ``parallel_env``, of which ``reward`` has no effect."""
        super().__init__(network, **options)
        services, accounts = self.network.services, self.network.accounts
        self.reward_names = (CIRCULARITY, *(each.id for each in services), *(each.id for each in accounts))
        shape = (len(self.reward_names),)
        self.reward_spaces = {agent: Box(-np.inf, np.inf, shape, np.float32) for agent in self.possible_agents}

    def reward_space(self, agent: str) -> Box[np.float32]:
        """Return the space of the rewards of ``agent``."""
        return self.reward_spaces[agent]

    def step(  # type: ignore[override]  # a vector takes the place of a number
        self, actions: Mapping[str, ArrayLike]
    ) -> tuple[
        dict[str, NDArray[np.float32]],
        dict[str, NDArray[np.float32]],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Hold one action per agent for an interval; see ``NetworkParallelEnv.step``."""
        before = self.batch.physical if self.agents else None
        observations, _, terminations, truncations, infos = super().step(actions)
        if before is None:
            return observations, {}, terminations, truncations, infos
        after = self.batch.physical
        sums = [
            np.concatenate([state.circularity, state.service[:, 0], -state.accounts[:, 0]]) for state in (before, after)
        ]
        reward = (sums[1] - sums[0]).astype(np.float32)
        return observations, {agent: reward.copy() for agent in observations}, terminations, truncations, infos


def mo_parallel_env(network: str | Path | Network, **options: Any) -> MOParallelEnv:
    """Return the network as a parallel environment with a vector of rewards; see ``MOParallelEnv``.

    >>> env = mo_parallel_env("carbo_net")
    >>> env.reward_names
    ('circularity', 'mobility', 'heat')
    >>> _ = env.reset(seed=0)
    >>> rewards = env.step(env.neutral_action)[1]
    >>> {reward.shape for reward in rewards.values()}
    {(3,)}
    """
    return MOParallelEnv(network, **options)
