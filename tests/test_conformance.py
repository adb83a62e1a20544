"""The conformance suite catches what breaks an environment, most of which PettingZoo's own test lets pass."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

from cirl_marl.testing import ConformanceError, check_parallel_env

Returned = tuple[dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any]]


def pettingzoo_passes(make: Callable[[], ParallelEnv[Any, Any, Any]]) -> bool:
    """Whether PettingZoo's parallel_api_test lets an environment pass without a warning or an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from pettingzoo.test import parallel_api_test
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            parallel_api_test(make(), num_cycles=20)
        except (AssertionError, Warning):
            return False
    return True


class Sound(ParallelEnv[str, Any, Any]):  # type: ignore[misc]
    """Two agents that add up their actions; the defects below break one thing each."""

    metadata: dict[str, Any] = {"name": "sound"}  # noqa: RUF012 (PettingZoo declares it so)

    def __init__(self) -> None:
        """Make spaces, one per agent."""
        self.possible_agents = ["a", "b"]
        self.agents: list[str] = []
        self.seen = {agent: Box(-100.0, 100.0, (2,), np.float32) for agent in self.possible_agents}
        self.acts = {agent: Box(-1.0, 1.0, (1,), np.float32) for agent in self.possible_agents}
        self.random = np.random.default_rng()
        self.total = 0.0
        self.steps = 0

    def observation_space(self, agent: str) -> Box:
        """Return the agent's own space."""
        return self.seen[agent]

    def action_space(self, agent: str) -> Box:
        """Return the agent's own space."""
        return self.acts[agent]

    def observe(self, agent: str) -> Any:
        """Return total and time."""
        return np.array([self.total, self.steps], dtype=np.float32)

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start at a random total."""
        if seed is not None:
            self.random = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        self.total, self.steps = float(self.random.uniform(-1, 1)), 0
        return {agent: self.observe(agent) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> Returned:
        """Add the actions to the total."""
        agents = list(self.agents)
        self.total += float(sum(action[0] for action in actions.values()))
        self.steps += 1
        over = self.steps >= 8
        self.agents = [] if over else agents
        return (
            {agent: self.observe(agent) for agent in agents},
            {agent: -abs(self.total) for agent in agents},
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, over),
            {agent: {} for agent in agents},
        )


def _with_entry(value: float) -> type[Sound]:
    class Entry(Sound):
        """Shows a wrong number at step 3."""

        def observe(self, agent: str) -> Any:
            """Return it."""
            seen = super().observe(agent)
            seen[0] = value if self.steps == 3 and agent == "b" else seen[0]
            return seen

    return Entry


class WrongDtype(Sound):
    """Shows float64."""

    def observe(self, agent: str) -> Any:
        """Return it."""
        return super().observe(agent).astype(np.float64)


class WrongShape(Sound):
    """Shows a column."""

    def observe(self, agent: str) -> Any:
        """Return it."""
        return super().observe(agent)[:, None]


class IgnoredSeed(Sound):
    """Resets differently under the same seed."""

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Drop the seed."""
        return super().reset(None, options)


class LateNoise(Sound):
    """Is not deterministic from step 2 on."""

    def step(self, actions: dict[str, Any]) -> Returned:
        """Add noise."""
        self.total += float(np.random.default_rng().random()) if self.steps >= 1 else 0.0
        return super().step(actions)


class RunOn(Sound):
    """Carries something over a reset, as the published environments do with their step counter."""

    episodes = 0

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Count episodes."""
        self.episodes += 1
        return super().reset(seed, options)

    def step(self, actions: dict[str, Any]) -> Returned:
        """Go on differently in later episodes."""
        self.total += 0.1 * (self.episodes > 1)
        return super().step(actions)


class SharedSpace(Sound):
    """Gives both agents one space object."""

    def observation_space(self, agent: str) -> Box:
        """Return it."""
        return self.seen["a"]


class SharedActionSpace(Sound):
    """Gives both agents one space object."""

    def action_space(self, agent: str) -> Box:
        """Return it."""
        return self.acts["a"]


class FreshSpace(Sound):
    """Makes a space at every call."""

    def observation_space(self, agent: str) -> Box:
        """Return it."""
        return Box(-100.0, 100.0, (2,), np.float32)


class Buffer(Sound):
    """Writes every observation of an agent into one buffer."""

    def __init__(self) -> None:
        """Make the buffers."""
        super().__init__()
        self.buffer = {agent: np.zeros(2, np.float32) for agent in self.possible_agents}

    def observe(self, agent: str) -> Any:
        """Return it."""
        self.buffer[agent][:] = super().observe(agent)
        return self.buffer[agent]


class SharedMemory(Sound):
    """Shows both agents one array."""

    def step(self, actions: dict[str, Any]) -> Returned:
        """Return it twice."""
        observations, *rest = super().step(actions)
        return dict.fromkeys(observations, observations["a"]), *rest  # type: ignore[return-value]


def _with_part(index: int, value: Any, step: int = 3) -> type[Sound]:
    class Part(Sound):
        """Returns a wrong value for agent b in one of the five dicts."""

        def step(self, actions: dict[str, Any]) -> Returned:
            """Return it."""
            returned = super().step(actions)
            if self.steps == step:
                returned[index]["b"] = value
            return returned

    return Part


class MissingKey(Sound):
    """Forgets an agent's info."""

    def step(self, actions: dict[str, Any]) -> Returned:
        """Drop it."""
        returned = super().step(actions)
        del returned[4]["b"]
        return returned


class ExtraKey(Sound):
    """Rewards a stranger."""

    def step(self, actions: dict[str, Any]) -> Returned:
        """Add it."""
        returned = super().step(actions)
        returned[1]["c"] = 0.0
        return returned


class Growing(Sound):
    """Lets an agent join in mid-episode."""

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin with one."""
        observations, infos = super().reset(seed, options)
        self.agents = ["a"]
        return {"a": observations["a"]}, {"a": infos["a"]}

    def step(self, actions: dict[str, Any]) -> Returned:
        """Let b join."""
        returned = super().step(actions)
        if self.steps == 3:
            self.agents = ["a", "b"]
        return returned


class Mutating(Sound):
    """Clips the caller's actions in place."""

    def step(self, actions: dict[str, Any]) -> Returned:
        """Clip them."""
        for action in actions.values():
            action *= 0.5
        return super().step(actions)


class Undead(Sound):
    """Keeps its agents after the end."""

    def step(self, actions: dict[str, Any]) -> Returned:
        """Keep them."""
        returned = super().step(actions)
        self.agents = list(self.possible_agents)
        return returned


class NoRestart(Sound):
    """Cannot be reset in mid-episode."""

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Keep what there was."""
        total, running = self.total, 0 < self.steps < 8
        returned = super().reset(seed, options)
        if running:
            self.total = total
        return returned if not running else ({a: self.observe(a) for a in self.agents}, returned[1])


DEFECTS: list[Any] = [
    pytest.param(_with_entry(np.nan), "agent 'b', step 3: observation: entry .0,. is nan", True, id="nan"),
    pytest.param(_with_entry(np.inf), "agent 'b', step 3: observation: entry .0,. is inf", True, id="inf"),
    pytest.param(_with_entry(101.0), r"agent 'b', step 3.*is 101.0, outside \[-100.0, 100.0\]", True, id="range"),
    pytest.param(WrongDtype, "agent 'a', step 0: observation: dtype float64, expected float32", True, id="dtype"),
    pytest.param(WrongShape, r"agent 'a', step 0: observation: shape \(2, 1\), expected \(2,\)", True, id="shape"),
    pytest.param(IgnoredSeed, "step 0: two environments after reset with the same seed differ", True, id="reset"),
    pytest.param(LateNoise, "step 2: two environments with the same seed and actions differ", True, id="step-2"),
    pytest.param(RunOn, "step 1: one environment run twice .* differ", True, id="run-on"),
    pytest.param(SharedSpace, "'a' and 'b' share one observation space object", True, id="shared-space"),
    pytest.param(SharedActionSpace, "'a' and 'b' share one action space object", True, id="shared-action-space"),
    pytest.param(FreshSpace, "observation_space returned another object", False, id="fresh-space"),
    pytest.param(Buffer, "observations returned at step 0 changed", True, id="buffer"),
    pytest.param(SharedMemory, "'a' and 'b' share an observation's memory", True, id="shared-memory"),
    pytest.param(_with_part(1, np.nan), "agent 'b', step 3: reward nan is not finite", True, id="reward-nan"),
    pytest.param(_with_part(1, "much"), "agent 'b', step 3: reward 'much' is not a number", True, id="reward-str"),
    pytest.param(_with_part(2, 0), "agent 'b', step 3: termination 0 is not a bool", True, id="termination"),
    pytest.param(_with_part(3, None), "agent 'b', step 3: truncation None is not a bool", True, id="truncation"),
    pytest.param(MissingKey, r"step 1: infos have keys \['a'\]", False, id="missing-key"),
    pytest.param(ExtraKey, r"step 1: rewards have keys \['a', 'b', 'c'\]", False, id="extra-key"),
    pytest.param(Growing, r"step 3: agents \['b'\] joined", False, id="growing"),
    pytest.param(Mutating, "step 1: the actions were changed", True, id="mutating"),
    pytest.param(Undead, "step 8: done is True, but env.agents", False, id="undead"),
    pytest.param(NoRestart, "step 0: one environment reset twice with the same seed differ", True, id="no-restart"),
]


def test_sound_environment_conforms() -> None:
    """The environment that the defects are planted in has none of its own."""
    check_parallel_env(Sound)
    assert pettingzoo_passes(Sound)


@pytest.mark.parametrize(("defect", "message", "missed"), DEFECTS)
def test_planted_defects_are_caught(defect: type[Sound], message: str, missed: bool) -> None:
    """Each planted defect is named; ``missed``: PettingZoo's own test lets it pass without a word."""
    with pytest.raises(ConformanceError, match=message):
        check_parallel_env(defect)
    assert pettingzoo_passes(defect) == missed


def test_other_spaces_conform() -> None:
    """Discrete, MultiDiscrete, MultiBinary, Dict and Tuple spaces are checked part by part."""

    class Mixed(Sound):
        def __init__(self) -> None:
            super().__init__()
            self.mixed = {
                agent: gymnasium.spaces.Dict(
                    {
                        "pair": gymnasium.spaces.Tuple(
                            (gymnasium.spaces.Discrete(9), gymnasium.spaces.MultiDiscrete([9, 2]))
                        ),
                        "bits": gymnasium.spaces.MultiBinary(2),
                    }
                )
                for agent in self.possible_agents
            }
            self.kinds = {agent: gymnasium.spaces.Discrete(3) for agent in self.possible_agents}
            self.most = 8

        def observation_space(self, agent: str) -> Any:
            return self.mixed[agent]

        def action_space(self, agent: str) -> Any:
            return self.kinds[agent]

        def observe(self, agent: str) -> Any:
            bits = np.array([self.steps % 2, 1], dtype=np.int8)
            return {"pair": (self.steps, np.array([min(self.steps, self.most), 1])), "bits": bits}

        def step(self, actions: dict[str, Any]) -> Returned:
            return super().step({agent: [action] for agent, action in actions.items()})

    class Beyond(Mixed):
        def observe(self, agent: str) -> Any:
            seen = super().observe(agent)
            seen["pair"][1][1] = 2 if self.steps == 4 else 1
            return seen

    check_parallel_env(Mixed)
    with pytest.raises(ConformanceError, match=r"agent 'a', step 4: observation\['pair'\]\[1\]"):
        check_parallel_env(Beyond)
