"""A network as a task of BenchMARL: the batched environment of TorchRL, all agents in one group."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from cirl_marl.adapters import needs
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.network import Network

with needs("benchmarl", "'cirl-marl[benchmarl]'"):
    from benchmarl.environments import TaskClass

    from cirl_marl.adapters.torchrl import GROUP, TorchRLEnv


class NetworkTask(TaskClass):  # type: ignore[misc]
    """A network for the experiments of BenchMARL, which makes as many copies of it as its configuration says."""

    def __init__(self, network: str | Path | Network, **options: Any) -> None:
        """Describe the task.

        Args:
            network: catalogue name, path of a definition file, or a network.
            **options: those of ``TorchRLEnv``, but for ``num_envs`` and ``seed``, which BenchMARL sets.

        Raises:
            CirlError: for an unknown network or option.
        """
        env = MultiAgentVectorEnv(network, num_envs=1, **{k: v for k, v in options.items() if k != "bootstrap"})
        super().__init__(env.network.name, {"network": str(network), **options})
        self._agents, self._horizon = list(env.agents), env.network.episode.horizon
        self._make_env = partial(TorchRLEnv, network, **options)

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], TorchRLEnv]:
        """Return what makes ``num_envs`` copies."""
        return partial(self._make_env, num_envs=num_envs, seed=seed)

    def supports_continuous_actions(self) -> bool:
        """Actions are continuous."""
        return True

    def supports_discrete_actions(self) -> bool:
        """Actions are not discrete."""
        return False

    def max_steps(self, env: Any) -> int:
        """Return the decisions of an episode."""
        return self._horizon

    def has_render(self, env: Any) -> bool:
        """A batch is not drawn."""
        return False

    def group_map(self, env: Any) -> dict[str, list[str]]:
        """Return the one group."""
        return {GROUP: self._agents}

    def observation_spec(self, env: Any) -> Any:
        """Return the specification of what one copy shows."""
        return env.full_observation_spec_unbatched

    def action_spec(self, env: Any) -> Any:
        """Return the specification of what is done in one copy."""
        return env.full_action_spec_unbatched

    def info_spec(self, env: Any) -> None:
        """No infos."""

    def state_spec(self, env: Any) -> None:
        """No common state: critics of all agents take their observations together."""

    def action_mask_spec(self, env: Any) -> None:
        """No masks, as no actions are discrete."""

    @staticmethod
    def env_name() -> str:
        """Return the name under which BenchMARL files results."""
        return "cirl_marl"
