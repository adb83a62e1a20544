"""One agent of a material network as a Gymnasium environment; the others hold their neutral control."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.environments.parallel import OPTIONS, GymnasiumView, NetworkParallelEnv, check_options
from cirl_marl.environments.state import Snapshot
from cirl_marl.errors import CirlError
from cirl_marl.network import Network


class SingleAgentEnv(GymnasiumView):
    """One compartment of a network acts.

    With ``scenario="paper"`` this is the environment of the CiRL paper: its observation is the state in the paper's
    order and its reward the paper's. ``info["state"]`` is that state in float64; the rest of ``info`` is that of the
    PettingZoo view.

    Attributes:
        agent: the compartment that acts.
    """

    def __init__(
        self,
        network: str | Path | Network,
        agent: str | None = None,
        *,
        scenario: str | None = None,
        legacy_episode: bool = False,
        **options: Any,
    ) -> None:
        """Make the environment.

        Args:
            network: catalogue name, path of a definition file, or a network.
            agent: who acts; None if the scenario has exactly one agent.
            scenario: scenario of the definition; where several agents have one each, as in ``paper_truck`` and
                ``paper_incinerator``, ``paper`` means that of ``agent``.
            legacy_episode: reproduce the step counter of the published classes. It is checked at the start of a step
                and survives ``reset``: when it has reached the horizon, the state is drawn anew, one step is taken from
                there, and its time limit is reported as termination. So the first episode has horizon + 1 steps, and
                each later one horizon − 1 and one more from a fresh start.
            **options: those of ``parallel_env``, but for ``agents``.

        Raises:
            CirlError: if ``agent`` is missing or unknown, or the scenario is not the only one of its name for it.
        """
        if "agents" in options:
            raise CirlError("a single-agent environment takes agent=, not agents=")
        check_options(options, (*OPTIONS, "reward", "render_mode"), "agent", "scenario", "legacy_episode")
        if not isinstance(agent, str | None):
            raise CirlError(f"agent must be the name of one agent, got {agent!r}")
        definition = load_network(network)
        name = _scenario_of(definition, scenario, agent)
        agents = None if agent is None else [agent]
        super().__init__(NetworkParallelEnv(definition, scenario=name, agents=agents, **options))
        if len(self.parallel.possible_agents) != 1:
            choices = ", ".join(self.parallel.possible_agents)
            raise CirlError(f"network '{self.network.name}' has several agents: give agent=, one of {choices}")
        self.agent = self.parallel.possible_agents[0]
        self._legacy, self._legacy_steps = legacy_episode, 0
        self.observation_space = self.parallel.observation_space(self.agent)
        self.action_space = self.parallel.action_space(self.agent)
        self.observation_names = {self.agent: self.parallel.observation_names[self.agent]}
        rows = {name: row for row, name in enumerate(self.parallel.state_names)}
        self._order = np.array([rows[name] for name in self.parallel.layout.array_order or rows], dtype=np.intp)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; ``options={"initial_state": …}`` takes a mapping or, in the paper scenarios, an array."""
        observations, infos = self.parallel.reset(seed=seed, options=options)
        super().reset(seed=None if seed is None else int(seed))
        return observations[self.agent], {**infos[self.agent], "state": self._paper_state()}

    def step(self, action: ArrayLike) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold the action, shape (1,) in [−1, 1], for one control interval."""
        over = self._legacy and self._legacy_steps >= self.network.episode.horizon
        if over:
            self.parallel.reset()
            self._legacy_steps = 0
        self._legacy_steps += 1
        observations, rewards, terminations, truncations, infos = self.parallel.step({self.agent: action})
        info = {**infos[self.agent], "state": self._paper_state()}
        agent, truncated = self.agent, truncations[self.agent] and not self._legacy
        return observations[agent], rewards[agent], terminations[agent] or over, truncated, info

    def snapshot(self) -> Snapshot:
        """Return a copy of the whole environment state, random streams included."""
        return replace(self.parallel.snapshot(), legacy_steps=self._legacy_steps)

    def restore(self, snapshot: Snapshot) -> NDArray[np.float32]:
        """Go back to a snapshot and return the observation there."""
        observations = self.parallel.restore(snapshot)
        self._legacy_steps = snapshot.legacy_steps
        return observations[self.agent]

    def _paper_state(self) -> NDArray[np.float64]:
        return self.parallel.state()[self._order]


def _scenario_of(network: Network, scenario: str | None, agent: str | None) -> str | None:
    """Return ``scenario`` or, if there is none of that name, the ``scenario_…`` in which ``agent`` alone acts."""
    if scenario is None or scenario == network.scenario_name or scenario in network.scenarios:
        return scenario
    of_agent = [name for name, variant in network.scenarios.items() if variant.default_agents == (agent,)]
    names = [name for name in of_agent if name.startswith(f"{scenario}_")]
    if len(names) > 1:
        raise CirlError(f"network '{network.name}': '{agent}' has scenarios {', '.join(names)}: give one of them")
    return names[0] if names else scenario


def single_agent_env(network: str | Path | Network, agent: str | None = None, **options: Any) -> SingleAgentEnv:
    """Return one agent of ``network`` as a Gymnasium environment; see ``GoalEnv`` for one whose task is a goal.

    >>> env = single_agent_env("copper_net", agent="use_to_collection", scenario="paper")
    >>> observation, info = env.reset(seed=0)
    >>> info["state"]
    array([  65.,   80.,   80., 1300.,   15.,   15.])
    """
    return SingleAgentEnv(network, agent, **options)
