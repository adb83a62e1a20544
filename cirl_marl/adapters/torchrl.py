"""The batched environment for TorchRL: all copies of a network in one step, all agents in one group."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cirl_marl.adapters import needs
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import ControlError
from cirl_marl.network import Network

with needs("torchrl", "'cirl-marl[torchrl]'"):
    import torch
    from tensordict import TensorDict
    from torchrl.data import Binary, Bounded, Composite, Unbounded
    from torchrl.envs import EnvBase

GROUP = "agents"
"""Key of what belongs to the agents: ``observation``, ``action`` and ``reward``, each of shape (copies, agents, …)."""


class TorchRLEnv(EnvBase):  # type: ignore[misc]
    """``num_envs`` copies of a network, of batch size [num_envs], for the collectors and losses of TorchRL.

    Agents whose observation or action has fewer entries than the longest see zeros at the end, and what they do there
    is left unread. The end of an episode is a truncation, as a clock ends it and not the physics.

    Attributes:
        vector_env: the copies; TorchRL starts their next episodes, so that they do not restart by themselves.
        group_map: the agents of the one group, in the order of its arrays.
    """

    def __init__(
        self,
        network: str | Path | Network,
        *,
        num_envs: int = 64,
        seed: int | None = None,
        bootstrap: bool = True,
        **options: Any,
    ) -> None:
        """Make the copies.

        Args:
            network: catalogue name, path of a definition file, or a network.
            num_envs: number of copies, B.
            seed: copy i begins with ``seed + i``; None draws it.
            bootstrap: whether a value is expected after the last step. If not, the end is a termination.
            **options: those of ``MultiAgentVectorEnv``.

        Raises:
            CirlError: for an unknown network or option.
        """
        super().__init__(device="cpu", batch_size=torch.Size([num_envs]))
        self.vector_env = MultiAgentVectorEnv(network, num_envs=num_envs, **options)
        self.group_map = {GROUP: list(self.vector_env.agents)}
        self._bootstrap, self._next_seed = bootstrap, seed
        observations = [self.vector_env.observation_spaces[agent] for agent in self.vector_env.agents]
        actions = [self.vector_env.action_spaces[agent] for agent in self.vector_env.agents]
        # entry j of agent i is entry i * longest + j of the flat, padded arrays
        self._observation_places, entries = _padding([space.shape[0] for space in observations])
        self._action_places, action_entries = _padding([space.shape[0] for space in actions])
        agents = (num_envs, len(observations))
        self._shape_of_observations, self._shape_of_actions = (*agents, entries), (*agents, action_entries)
        ends = np.zeros((2, len(observations) * entries), dtype=np.float32)
        ends[:, self._observation_places] = np.concatenate([[space.low, space.high] for space in observations], axis=1)
        low, high = (torch.from_numpy(end).reshape(agents[1], entries).expand(*agents, entries) for end in ends)
        flag = Binary(n=1, shape=(num_envs, 1), dtype=torch.bool)
        self.observation_spec = _in_group("observation", Bounded(low, high, dtype=torch.float32), agents)
        self.action_spec = _in_group(
            "action", Bounded(-1.0, 1.0, (*agents, action_entries), dtype=torch.float32), agents
        )
        self.reward_spec = _in_group("reward", Unbounded((*agents, 1)), agents)
        flags = {name: flag.clone() for name in ("done", "terminated", "truncated")}
        self.done_spec = Composite(**flags, shape=(num_envs,))

    def _reset(self, tensordict: Any = None, **_: Any) -> Any:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None and not mask.all():
            raise ControlError("all copies begin an episode together, as all are of one length: reset all of them")
        observations = self.vector_env.reset(self._next_seed)
        self._next_seed = None  # the streams go on
        observation = np.concatenate(list(observations.values()), axis=1)
        return self._outcome(observation.T, np.zeros(self.vector_env.num_envs, dtype=bool))

    def _step(self, tensordict: Any) -> Any:
        actions = tensordict[GROUP, "action"].detach().numpy()
        if actions.shape != self._shape_of_actions:
            raise ControlError(f"actions must have shape {self._shape_of_actions}, got {actions.shape}")
        action_rows = actions.reshape(len(actions), -1).T[self._action_places]
        outcome = self.vector_env.advance(action_rows.astype(float))
        outcome_tensors = self._outcome(outcome.observation, outcome.truncated)
        rewards = torch.from_numpy(outcome.reward.T.astype(np.float32))
        outcome_tensors[GROUP].set("reward", rewards.unsqueeze(-1))
        return outcome_tensors

    def _outcome(self, observation: NDArray[np.float32], truncation: NDArray[np.bool_]) -> Any:
        """Return padded observations, of those stacked in shape (entries of all agents, B), and who is at the end."""
        shape = self._shape_of_observations
        rows = np.zeros((shape[0], shape[1] * shape[2]), dtype=np.float32)
        rows[:, self._observation_places] = observation.T
        group = TensorDict({"observation": torch.from_numpy(rows).view(shape)}, batch_size=shape[:2])
        done, never = torch.from_numpy(truncation.copy()).unsqueeze(-1), torch.zeros(shape[0], 1, dtype=torch.bool)
        flags = (done, never) if self._bootstrap else (never, done)
        return TensorDict(
            {GROUP: group, "done": done.clone(), "truncated": flags[0], "terminated": flags[1]}, batch_size=shape[:1]
        )

    def _set_seed(self, seed: int | None) -> None:
        """Have the next reset begin copy i with ``seed + i``."""
        self._next_seed = seed


def _padding(lengths: list[int]) -> tuple[NDArray[np.intp], int]:
    """Return the place of each entry among rows that are padded to the longest, and that length."""
    longest = max(lengths)
    places = [i * longest + np.arange(length) for i, length in enumerate(lengths)]
    return np.concatenate(places), longest


def _in_group(name: str, spec: Any, shape: tuple[int, int]) -> Any:
    return Composite({GROUP: Composite({name: spec}, shape=shape)}, shape=shape[:1])
