"""All agents of a network as one, for learners of a single agent: a Gymnasium environment, alone and in a batch.

The joint action is that of all agents one after the other, the joint observation likewise, and the reward is the mean
of the agents' rewards: λ itself if every agent is paid λ. It is what the learners of ``joint`` recipes see.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from cirl_marl.environments.actuators import action_array
from cirl_marl.environments.parallel import OPTIONS, GymnasiumView, NetworkParallelEnv, check_options, first_copy
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, ControlError, check_names
from cirl_marl.network import Floats, Network

JointObservation = NDArray[np.float32]


class JointEnv(GymnasiumView):
    """One copy of a network in which one learner acts for all agents.

    ``info`` has the keys of ``MultiAgentVectorEnv.team_info``, as numbers of this copy; in the last step of an episode
    also ``episode_circularity`` and ``episode_service_level``.

    Attributes:
        parallel: the same environment as a dict of agents, which says what each entry is.
    """

    def __init__(self, network: str | Path | Network, **options: Any) -> None:
        """Make the environment; options and errors are those of ``parallel_env``."""
        super().__init__(NetworkParallelEnv(network, **options))
        self.observation_space: spaces.Space[Any]
        self.action_space: spaces.Space[Any]
        self.observation_space, self.action_space, self._entries = _joint_spaces(self.parallel.batch)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[JointObservation, dict[str, Any]]:
        """Start an episode; options are those of ``MultiAgentVectorEnv.reset``."""
        observations, infos = self.parallel.reset(seed=seed, options=options)
        super().reset(seed=seed)
        return np.concatenate([*observations.values()]), infos[self.parallel.agents[0]]

    def step(self, action: ArrayLike) -> tuple[JointObservation, float, bool, bool, dict[str, Any]]:
        """Hold the actions of all agents, one after the other in [−1, 1], for one control interval.

        Raises:
            ControlError: for a wrong shape, NaN, values out of bounds, or an episode that is over.
        """
        batch = self.parallel.batch
        outcome = self.parallel.advance(_columns(action, (self._entries,)))
        info, truncated = batch.team_info(outcome), bool(outcome.truncated[0])
        if truncated:
            info |= batch.episode_figures()
        return outcome.observation[:, 0], _mean(outcome.reward).item(), False, truncated, first_copy(info)


class JointVectorEnv(gymnasium.vector.VectorEnv[JointObservation, JointObservation, NDArray[Any]]):
    """``num_envs`` copies of a network, stepped as one batch, in each of which one learner acts for all agents.

    Every episode ends at the horizon, so that all copies end at once. When they do, ``metadata["autoreset_mode"]`` says
    what follows, as in Gymnasium's own vector environments: with ``NextStep`` the next step starts the next episode,
    whatever its actions, and pays 0; with ``SameStep`` the same step does, and ``infos`` has the last observations and
    infos as ``final_obs`` and ``final_info``. Infos are otherwise those of ``JointEnv``, as arrays.

    Attributes:
        batch: the same environments as a dict of agents.

    >>> envs = gymnasium.make_vec("cirl_marl/copper_net-v0", num_envs=3)
    >>> observations, infos = envs.reset(seed=0)
    >>> observations, rewards, terminations, truncations, infos = envs.step(envs.action_space.sample())
    >>> rewards.shape, infos["cost"].shape
    ((3,), (3,))
    """

    def __init__(
        self,
        network: str | Path | Network,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        """Make the environments; ``options`` and errors are those of ``vector_env``."""
        check_options(options, (*OPTIONS, "scenario", "agents", "reward"), "num_envs", "autoreset_mode")
        modes = {mode.value: mode for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)}
        mode = autoreset_mode.value if isinstance(autoreset_mode, AutoresetMode) else autoreset_mode
        check_names("autoreset_mode", [mode], modes)
        self.batch = MultiAgentVectorEnv(network, num_envs=num_envs, **options)
        if not self.batch.agents:
            raise CirlError(f"network '{self.batch.network.name}': no compartment has a control, so nothing can act")
        self.num_envs = num_envs
        self.metadata = {"name": str(self.batch), "render_modes": [], "autoreset_mode": modes[mode]}
        self.single_observation_space, self.single_action_space, self._entries = _joint_spaces(self.batch)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._over = False

    def __str__(self) -> str:
        """Return the name of the network and its scenario."""
        return str(self.batch)

    def reset(  # a seed for each copy, too
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[JointObservation, dict[str, Any]]:
        """Start an episode in every copy; arguments are those of ``MultiAgentVectorEnv.reset``."""
        observations = self.batch.reset(seed, options)
        super().reset(seed=int(seed) if isinstance(seed, int | np.integer) else None)
        self._over, infos = False, self.batch.drawn_info(self.batch.physical.step)
        return np.ascontiguousarray(np.concatenate([*observations.values()], axis=1)), infos

    def step(
        self, actions: ArrayLike
    ) -> tuple[JointObservation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Hold the actions of all agents, shape (num_envs, their entries) in [−1, 1], for one control interval.

        Raises:
            ControlError: for a wrong shape, NaN or values out of bounds.
        """
        no, batch = np.zeros(self.num_envs, dtype=bool), self.batch
        if self._over:
            observation, infos = self.reset()
            return observation, np.zeros(self.num_envs), no, no.copy(), infos
        outcome = batch.advance(_columns(actions, (self.num_envs, self._entries)))
        observation, infos = np.ascontiguousarray(outcome.observation.T), batch.team_info(outcome)
        if outcome.truncated.all():
            infos |= batch.episode_figures()
            self._over = True
            if self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP:
                finals = np.full(self.num_envs, None)
                for copy, row in enumerate(observation):
                    finals[copy] = row
                final_info = infos
                observation, infos = self.reset()
                infos |= {"final_obs": finals, "_final_obs": outcome.truncated}
                infos |= {"final_info": final_info, "_final_info": outcome.truncated}
        return observation, _mean(outcome.reward), no, outcome.truncated, infos


def _joint_spaces(batch: MultiAgentVectorEnv) -> tuple[Box, Box, int]:
    """Return the spaces of the observations and actions of all agents, one after the other, and the actions' length."""
    boxes = batch.observation_spaces.values()
    entries = sum(box.shape[0] for box in batch.action_spaces.values())
    low, high = (np.concatenate([getattr(box, end) for box in boxes]) for end in ("low", "high"))
    return Box(low, high, dtype=np.float32), Box(-1.0, 1.0, (entries,), np.float32), entries


def _columns(actions: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Return joint actions as columns, shape (entries, B); a ``ControlError`` says why they cannot be."""
    array = action_array("joint action", actions)
    if array.shape != shape:
        raise ControlError(f"joint action has shape {array.shape}, expected {shape}")
    if array.dtype.kind not in "biuf":
        raise ControlError(f"joint action is {array!r}; it must hold numbers in [-1, 1]")
    return np.ascontiguousarray(np.atleast_2d(array).T, dtype=np.float64)


def _mean(rewards: Floats) -> Floats:
    """Return the mean over agents, shape (B,); they are added one after the other, whatever B is."""
    mean: Floats = np.add.accumulate(rewards)[-1] / len(rewards)
    return mean
