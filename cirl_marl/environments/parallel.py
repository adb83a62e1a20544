"""The environment of a material network for PettingZoo: parallel, and AEC through PettingZoo's conversion."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import conversions

from cirl_marl.environments.actuators import action_array, wrong_shape
from cirl_marl.environments.state import Outcome, Snapshot
from cirl_marl.environments.vector import Infos, MultiAgentVectorEnv, Observations
from cirl_marl.errors import CirlError, ControlError, unknown_name
from cirl_marl.network import Floats, Network

RENDER_MODES = ("rgb_array", "human")
METADATA: dict[str, Any] = {"name": "cirl_marl", "render_modes": [*RENDER_MODES], "render_fps": 10}
OPTIONS = ("observe", "countdown", "circularity", "circularity_weight", "charges", "horizon", "uncertain")


def check_options(options: Iterable[str], choices: Sequence[str], *arguments: str) -> None:
    """Refuse options that are not among the ``choices``; ``arguments`` are those that have a place of their own."""
    for option in options:
        if option not in choices:
            raise CirlError(unknown_name("option", option, (*choices, *arguments)))


class NetworkParallelEnv(ParallelEnv[str, NDArray[np.float32], NDArray[np.float32]]):  # type: ignore[misc]
    """One copy of a material network whose compartments are PettingZoo agents.

    Each agent has its own Box(−1, 1) action and its own float32 observation; ``observation_names[agent]`` says what
    each entry is. Episodes end by truncation at the horizon. ``infos[agent]`` has the keys of
    ``MultiAgentVectorEnv.team_info``, as numbers of this copy, ``local_reward`` and, if the agent's model has a
    criterion, ``success``.

    Attributes:
        network: the network under the chosen scenario.
        possible_agents: compartments that act.
        state_names: what the entries of ``state()`` are, but for the last, the elapsed share of the episode.
        agents: the same while an episode runs, empty after it.
        batch: the same environment for those who want arrays, with a single copy.
    """

    metadata: dict[str, Any] = {**METADATA, "is_parallelizable": True}  # noqa: RUF012 (PettingZoo declares it so)

    def __init__(
        self,
        network: str | Path | Network,
        *,
        scenario: str | None = None,
        agents: Sequence[str] | None = None,
        reward: str | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        """Make the environment; ``options`` and errors are those of ``MultiAgentVectorEnv``."""
        check_options(options, OPTIONS, "scenario", "agents", "reward", "render_mode")
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise CirlError(unknown_name("render_mode", render_mode, RENDER_MODES))
        self.batch = MultiAgentVectorEnv(
            network, num_envs=1, scenario=scenario, agents=agents, reward=reward, **options
        )
        self.network = self.batch.network
        self.metadata = {**self.metadata, "name": str(self.batch)}
        if not self.batch.agents:
            raise CirlError(f"network '{self.network.name}': no compartment has a control, so nothing can act")
        self.layout = self.batch.layout
        self.possible_agents = list(self.batch.agents)
        self.agents: list[str] = []
        self.observation_spaces = dict(self.batch.observation_spaces)
        self.observation_names = self.batch.observation_names
        self.action_spaces = dict(self.batch.action_spaces)
        self.state_names = self.batch.state_names
        self._entries = sum(neutral.shape[1] for neutral in self.batch.neutral_action.values())
        self.state_space = Box(-np.inf, np.inf, (len(self.state_names) + 1,), np.float64)
        self.render_mode = render_mode
        self._canvas: Any = None

    def observation_space(self, agent: str) -> Box[np.float32]:
        """Return the observation space of ``agent``, always the same object."""
        return self.batch.observation_spaces[agent]

    def action_space(self, agent: str) -> Box[np.float32]:
        """Return the action space of ``agent``, always the same object."""
        return self.batch.action_spaces[agent]

    @property
    def neutral_action(self) -> dict[str, NDArray[np.float32]]:
        """The action of each agent that leaves it neutral in the coming interval."""
        return {agent: action[0].astype(np.float32) for agent, action in self.batch.neutral_action.items()}

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Observations, Infos]:
        """Start an episode; ``options={"initial_state": {node: stock}}`` starts it from a given state."""
        if seed is not None and not isinstance(seed, int | np.integer):
            raise ControlError(f"seed {seed!r} must be a non-negative integer")
        observations = self.batch.reset(seed, options)
        self.agents = list(self.possible_agents)
        if self.render_mode == "human":
            self.render()
        drawn = first_copy(self.batch.drawn_info(self.batch.physical.step))
        infos: Infos = {agent: dict(drawn) for agent in self.agents}
        return first_copy(observations), infos

    def step(
        self, actions: Mapping[str, ArrayLike]
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Hold one action per agent, each in its Box(−1, 1), for one control interval.

        Raises:
            ControlError: for missing or unknown agents, wrong shapes, NaN or values out of bounds.
        """
        if not self.agents:
            if actions:
                raise ControlError("no episode is running: call reset()")
            return {}, {}, {}, {}, {}
        agents, outcome = self.possible_agents, self.advance(self._stack(actions))
        observation, slices = outcome.observation[:, 0], self.layout.slices
        observations = {agent: observation[slices[agent]] for agent in agents}
        rewards = dict(zip(agents, outcome.reward[:, 0].tolist(), strict=True))
        terminations, truncations = (dict.fromkeys(agents, flag) for flag in (False, bool(outcome.truncated[0])))
        return observations, rewards, terminations, truncations, self._infos(outcome)

    def advance(self, actions: Floats) -> Outcome:
        """Hold the actions of all agents one after the other, shape (entries, 1); see ``MultiAgentVectorEnv``."""
        outcome = self.batch.advance(actions)
        if outcome.truncated[0]:
            self.agents = []
        if self.render_mode == "human":
            self.render()
        return outcome

    def state(self) -> Floats:
        """Return the whole physical state: every stock in mass units, then the elapsed share of the episode."""
        state: Floats = self.batch.state()[0]
        return state

    def local_rewards(self) -> dict[str, float]:
        """Return the local reward that the current state gives each compartment, whether it acts or not."""
        return {name: float(reward[0]) for name, reward in self.batch.local_rewards().items()}

    def snapshot(self) -> Snapshot:
        """Return a copy of the whole environment state, random streams included."""
        return self.batch.snapshot()

    def restore(self, snapshot: Snapshot) -> Observations:
        """Go back to a snapshot and return the observations there."""
        observations: Observations = first_copy(self.batch.restore(snapshot))
        over = int(self.batch.physical.step[0]) >= self.network.episode.horizon
        self.agents = [] if over else list(self.possible_agents)
        return observations

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the digraph with its stocks and flows: an image (height, width, 3), or a window for ``human``.

        Flows are means over the last step, and λ is that of these flows, with what has moved in batches up to its end.
        """
        if self.render_mode is None:
            raise CirlError(f"render() needs render_mode, one of {', '.join(RENDER_MODES)}, when it is made")
        from cirl_marl.drawing.digraph import Canvas

        if self._canvas is None:
            self._canvas = Canvas(self.network, window=self.render_mode == "human")
        state = self.batch.physical
        time = float(state.step[0]) * self.network.episode.control_interval
        stock, flow = self.batch.rows.stocks(state.stock)[:, 0], state.flow[:, 0]
        circularity = float(self.network.circularity(flow, state.batched[:, 0]))
        image: NDArray[np.uint8] = self._canvas.draw(stock, flow, time, circularity)
        return image if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._canvas is not None:
            self._canvas.close()
            self._canvas = None

    def _stack(self, actions: Mapping[str, ArrayLike]) -> Floats:
        """Stack the actions; only if they do not stack are they looked at one by one, to say why."""
        if not isinstance(actions, Mapping):
            raise ControlError(f"actions must be a mapping agent → action, not {actions!r}")
        try:
            parts = [actions[agent] for agent in self.possible_agents]
            has_mask = any(isinstance(part, np.ma.MaskedArray) for part in parts)
            joint = np.empty(0) if has_mask else np.array(parts)
        except (KeyError, RuntimeError, TypeError, ValueError):
            joint = np.empty(0)
        fits = joint.shape == (self._entries, 1) and len(actions) == len(self.possible_agents)
        if not fits or joint.dtype.kind not in "biuf" or joint.dtype.itemsize > 8:  # long doubles
            return self.batch.stack({agent: self._as_row(agent, action) for agent, action in actions.items()})
        return joint

    def _as_row(self, agent: str, action: ArrayLike) -> NDArray[Any]:
        """Refuse an action of the wrong shape; the batch would say it with an axis that is not the user's."""
        row, space = action_array(f"action of agent '{agent}'", action), self.batch.action_spaces.get(agent)
        if space is not None and row.shape != space.shape:
            raise ControlError(wrong_shape(agent, row.shape, space.shape))
        return row[None]

    def _infos(self, outcome: Outcome) -> Infos:
        team, local = first_copy(self.batch.team_info(outcome)), outcome.local[:, 0].tolist()
        infos: Infos = {a: {**team, "local_reward": r} for a, r in zip(self.possible_agents, local, strict=True)}
        for agent in outcome.success.keys() & infos.keys():
            infos[agent]["success"] = bool(outcome.success[agent][0])
        return infos


class GymnasiumView(gymnasium.Env[Any, NDArray[np.float32]]):
    """What Gymnasium's views of a network have in common: they show ``parallel``, its PettingZoo view, otherwise."""

    metadata: dict[str, Any] = METADATA

    def __init__(self, parallel: NetworkParallelEnv) -> None:
        """Take the environment, its pictures and its name."""
        self.parallel = parallel
        self.metadata, self.render_mode = parallel.metadata, parallel.render_mode

    def __str__(self) -> str:
        """Return the name of the network and its scenario."""
        return str(self.parallel)

    @property
    def network(self) -> Network:
        """The network under the chosen scenario."""
        return self.parallel.network

    def render(self) -> Any:
        """Draw the network; see ``NetworkParallelEnv.render``."""
        return self.parallel.render()

    def close(self) -> None:
        """Close the window, if there is one."""
        self.parallel.close()


def first_copy(batch: Mapping[str, Any]) -> dict[str, Any]:
    """Return what arrays with a leading axis for copies hold of the first: numbers, and arrays of one axis less.

    >>> first_copy({"cost": np.array([0.5, 0.0]), "flows": np.array([[1.0, 2.0], [3.0, 4.0]])})
    {'cost': 0.5, 'flows': array([1., 2.])}
    """
    return {
        key: first_copy(value) if type(value) is dict else value.item(0) if value.ndim == 1 else value[0]
        for key, value in batch.items()
    }


def parallel_env(network: str | Path | Network, **options: Any) -> NetworkParallelEnv:
    """Return the network as a PettingZoo ParallelEnv; options: of ``MultiAgentVectorEnv``, and ``render_mode``.

    >>> env = parallel_env("copper_net", agents=["mine", "use_to_collection"])
    >>> observations, infos = env.reset(seed=0)
    >>> observations, rewards, *_ = env.step({"mine": [-1.0], "use_to_collection": [1.0]})
    >>> sorted(rewards)
    ['mine', 'use_to_collection']
    """
    return NetworkParallelEnv(network, **options)


def aec_env(network: str | Path | Network, **options: Any) -> AECEnv[str, Any, Any]:
    """Return the network as a PettingZoo AECEnv: agents act in turn, the network moves when all have acted."""
    return conversions.parallel_to_aec(NetworkParallelEnv(network, **options))


def vector_env(network: str | Path | Network, num_envs: int = 64, **options: Any) -> MultiAgentVectorEnv:
    """Return ``num_envs`` copies of the network, arrays in and out; see ``MultiAgentVectorEnv``.

    >>> env = vector_env("copper_net", num_envs=3)
    >>> env.reset(seed=0)["mine"].shape
    (3, 4)
    """
    check_options(options, (*OPTIONS, "scenario", "agents", "reward"))
    return MultiAgentVectorEnv(network, num_envs=num_envs, **options)
