"""Contracts of the environments, and that the conformance suite catches what breaks them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from cirl_marl import (
    CirlError,
    ControlError,
    VectorEnv,
    aec_env,
    load_network,
    networks,
    parallel_env,
    single_agent_env,
    vector_env,
)
from cirl_marl.controllers import Constant, Random, Scripted
from cirl_marl.evaluate import rollout
from cirl_marl.testing import ConformanceError, check_parallel_env, check_vector_env

CATALOGUE = [
    pytest.param(name, scenario, id=f"{name}-{scenario}")
    for name in networks()
    for scenario in ("default", *load_network(name).scenarios)
]
anything = pytest.mark.parametrize(("name", "scenario"), CATALOGUE)
Returned = tuple[dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any]]
third_party = [
    # importing pettingzoo.test loads PettingZoo's own games through its deprecated interface
    pytest.mark.filterwarnings("ignore:The old environment creation API:DeprecationWarning"),
    # PettingZoo would rather have homogeneous agents called player_0
    pytest.mark.filterwarnings("ignore:We recommend agents to be named"),
    pytest.mark.filterwarnings("ignore:Agents have different observation space sizes"),
    pytest.mark.filterwarnings("ignore:Observations are different shapes"),
    # the published environments have no bounds
    pytest.mark.filterwarnings("ignore:.*observation space (minimum )?(maximum )?value is -?infinity"),
    pytest.mark.filterwarnings("ignore:.*not including the .* infinite"),
]


def marked(test: Callable[..., None]) -> Callable[..., None]:
    """Let the warnings of others pass in this test."""
    for mark in third_party:
        test = mark(test)
    return test


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


@anything
@pytest.mark.parametrize("observe", [None, "local", "full"])
def test_catalogue_conforms(name: str, scenario: str, observe: str | None) -> None:
    """The stricter suite holds for every network, scenario and view."""
    check_parallel_env(lambda: parallel_env(name, scenario=scenario, observe=observe))
    check_vector_env(lambda: vector_env(name, num_envs=3, scenario=scenario, observe=observe, horizon=7), steps=20)


@marked
@anything
def test_pettingzoos_own_tests(name: str, scenario: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Parallel and AEC interface, and seeding."""
    from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test

    parallel_api_test(parallel_env(name, scenario=scenario), num_cycles=200)
    api_test(aec_env(name, scenario=scenario), num_cycles=30)
    parallel_seed_test(lambda: parallel_env(name, scenario=scenario), num_cycles=3)
    assert "Passed" in capsys.readouterr().out


@marked
@anything
def test_gymnasium_and_sb3_checkers(name: str, scenario: str) -> None:
    """The one-agent view, under both checkers."""
    from gymnasium.utils.env_checker import check_env as gymnasium_check
    from stable_baselines3.common.env_checker import check_env as sb3_check

    agent = load_network(name, scenario=scenario).agents[0]
    gymnasium_check(single_agent_env(name, agent=agent, scenario=scenario), skip_render_check=True)
    sb3_check(single_agent_env(name, agent=agent, scenario=scenario))


@pytest.mark.parametrize("id_", ["cirl_marl/CopperNet-v0", "cirl_marl/CarboNet-v0"])
def test_registered_environments(id_: str) -> None:
    """gymnasium.make finds them by id."""
    env = gymnasium.make(id_, disable_env_checker=True)
    assert env.action_space == Box(-1, 1, (1,), np.float32)
    env.close()


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


AGENTS = ("mine", "use_to_collection")


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ({"mine": [np.nan], "use_to_collection": [0.0]}, "'mine'.* is nan"),
        ({"mine": [0.0], "use_to_collection": [np.inf]}, "'use_to_collection'.* is inf"),
        ({"mine": [0.0], "use_to_collection": [1.5]}, r"'use_to_collection'.* is 1.5.*\[-1, 1\]"),
        ({"mine": [0.0, 0.0], "use_to_collection": [0.0]}, "'mine' has shape"),
        ({"mine": 0.0, "use_to_collection": [0.0]}, "'mine' has shape"),
        ({"mine": [0.0]}, "missing for .*'use_to_collection'"),
        ({"mine": [0.0], "use_to_colection": [0.0]}, "Did you mean 'use_to_collection'"),
        ({"mine": [0.0], "use_to_collection": [0.0], "use": [0.0]}, "unknown agent 'use'"),
        ({}, "missing for"),
        ({"mine": ["much"], "use_to_collection": [0.0]}, "'mine' is array.*much"),
    ],
)
def test_bad_actions(actions: dict[str, Any], message: str) -> None:
    """A refused action names its agent and leaves the environment as it was."""
    env = parallel_env("copper_net", agents=AGENTS)
    env.reset(seed=0)
    before = env.state().copy()
    with pytest.raises(ControlError, match=message):
        env.step(actions)
    np.testing.assert_array_equal(env.state(), before)
    env.step({agent: [0.0] for agent in AGENTS})


def test_acting_outside_an_episode() -> None:
    """Before reset and after the end."""
    env = parallel_env("copper_net", agents=AGENTS, horizon=1)
    with pytest.raises(ControlError, match=r"reset\(\)"):
        env.state()
    with pytest.raises(ControlError, match=r"reset\(\)"):
        env.step({agent: [0.0] for agent in AGENTS})
    env.reset(seed=0)
    assert all(env.step({agent: [0.0] for agent in AGENTS})[3].values())
    assert env.agents == []
    with pytest.raises(ControlError, match=r"reset\(\)"):
        env.step({agent: [0.0] for agent in AGENTS})
    env.reset()
    assert env.agents == list(AGENTS)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"agents": ["mime"]}, "unknown agent 'mime'. Did you mean 'mine'"),
        ({"agents": ["landfill"]}, "unknown agent 'landfill'"),
        ({"agents": []}, "at least one"),
        ({"agents": ["mine", "mine"]}, "distinct"),
        ({"agents": "mine"}, "sequence of ids in a fixed order"),
        ({"reward": "mixd"}, "unknown reward 'mixd'. Did you mean 'mixed'"),
        ({"observe": "neighbors"}, "unknown observation mode 'neighbors'. Did you mean 'neighbours'"),
        ({"observe": "stocks"}, "stocks"),
        ({"circularity": "ends"}, "unknown circularity 'ends'. Did you mean 'end'"),
        ({"scenario": "papr"}, "unknown scenario 'papr'. Did you mean 'paper'"),
        ({"num_envs": 0}, "num_envs.*0"),
        ({"horizon": 0}, "horizon must be a whole number of at least 1, got 0"),
    ],
)
def test_bad_options(options: dict[str, Any], message: str) -> None:
    """A wrong option is an error that gives the nearest valid one."""
    with pytest.raises(CirlError, match=message):
        VectorEnv("copper_net", **options)


def test_bad_options_of_the_views() -> None:
    """Names that only a view knows."""
    with pytest.raises(CirlError, match="unknown network"):
        parallel_env("copper")
    with pytest.raises(CirlError, match=r"unknown render_mode 'humn'. Did you mean 'human'"):
        parallel_env("copper_net", render_mode="humn")
    with pytest.raises(CirlError, match="several agents"):
        single_agent_env("copper_net")
    with pytest.raises(CirlError, match="agent=, not agents="):
        single_agent_env("copper_net", agents=["mine"])
    with pytest.raises(CirlError, match="Did you mean 'mine'"):
        single_agent_env("copper_net", agent="mime")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"usage": 1.0}, "unknown node or inner state 'usage'. Did you mean 'use'"),
        ({"use": -1.0}, "'use' is -1.0"),
        ({"use": np.nan}, "'use' is nan"),
        ({"use": [1.0, 2.0, 3.0]}, "'use' has shape"),
        ({"use": 1e9}, "1e.09 kt.*widen"),
        (np.zeros(6), "shape"),
    ],
)
def test_bad_initial_state(given: Any, message: str) -> None:
    """A refused state leaves the environment as it was."""
    env = vector_env("copper_net", num_envs=2)
    env.reset(3)
    before = env.state()
    with pytest.raises(ControlError, match=message):
        env.reset(4, options={"initial_state": given})
    np.testing.assert_array_equal(env.state(), before)


def test_initial_state_is_taken() -> None:
    """Given stocks are used, the others are drawn."""
    env = vector_env("copper_net", num_envs=2)
    env.reset(0, options={"initial_state": {"use": 150.0, "sorting": np.array([1.0, 2.0])}})
    index = env.network.node_index
    assert env.state()[:, index["use"]].tolist() == [150.0, 150.0]
    assert env.state()[:, index["sorting"]].tolist() == [1.0, 2.0]
    with pytest.raises(ControlError, match="Did you mean 'initial_state'"):
        env.reset(0, options={"initial_stat": {}})


@pytest.mark.parametrize("seed", [-1, [1, 2, 3], [1, -1], 1.5, "one"])
def test_bad_seeds(seed: Any) -> None:
    """A seed is a non-negative integer, or one for each copy."""
    with pytest.raises(ControlError, match="seed"):
        vector_env("copper_net", num_envs=2).reset(seed)


def test_seeds_of_copies() -> None:
    """A list seeds each copy; an integer s seeds copy i with s + i."""
    env = vector_env("copper_net", num_envs=3)
    env.reset(5)
    first = env.state()
    env.reset([7, 6, 5])
    np.testing.assert_array_equal(first, env.state()[::-1])


def test_bad_snapshots() -> None:
    """A snapshot of something else is refused."""
    env = vector_env("copper_net", num_envs=2)
    env.reset(0)
    snapshot = env.snapshot()
    for other in (
        vector_env("copper_net", num_envs=3),
        vector_env("copper_net", num_envs=2, agents=["mine"]),
        vector_env("carbo_net", num_envs=2),
        vector_env("copper_net", num_envs=2, scenario="paper", agents=list(env.agents)),
    ):
        with pytest.raises(ControlError, match="snapshot"):
            other.restore(snapshot)


def outcomes(reward: str, **options: Any) -> tuple[VectorEnv, list[Any]]:
    """Return an environment and what ten random steps of it brought."""
    env = vector_env("copper_net", num_envs=2, reward=reward, **options)
    env.reset(1)
    rng = np.random.default_rng(0)
    return env, [env.advance(rng.uniform(-1, 1, (len(env.agents), 2))) for _ in range(10)]


def test_reward_modes() -> None:
    """Local, circularity and mixed = w·λ/scale + (1 − w)·local, of the same trajectory."""
    env, mixed = outcomes("mixed")
    weight, scale = env.network.objective.circularity_weight, env.network.objective.circularity_scale
    _, local = outcomes("local")
    _, team = outcomes("circularity")
    _, mean = outcomes("circularity", circularity="mean")
    _, total = outcomes("local_sum")
    for a, b, c, d, e in zip(mixed, local, team, mean, total, strict=True):
        np.testing.assert_array_equal(b.reward, b.local)
        np.testing.assert_array_equal(c.reward, np.tile(c.circularity, (len(env.agents), 1)))
        np.testing.assert_array_equal(d.reward, np.tile(d.circularity_mean, (len(env.agents), 1)))
        np.testing.assert_allclose(
            a.reward, weight * c.circularity / scale + (1 - weight) * b.local, rtol=1e-13, atol=1e-15
        )
        assert (e.reward == e.reward[0]).all()
        assert (e.reward[0] <= b.local.sum(axis=0) + 1e-12).all()  # compartments that do not act count too


@pytest.mark.parametrize("circularity", ["end", "mean"])
def test_difference_reward_by_hand(circularity: str) -> None:
    """λ − λ with that agent neutral, re-simulated from a snapshot."""
    env = vector_env("copper_net", num_envs=2, reward="difference", circularity=circularity)
    imagined = vector_env("copper_net", num_envs=2, reward="circularity", circularity=circularity)
    env.reset(1)
    imagined.reset(1)
    rng = np.random.default_rng(0)
    neutral = env.stack({a: np.tile(n, (2, 1)) for a, n in env.neutral_action.items()})
    for _ in range(3):
        actions = rng.uniform(-1, 1, (len(env.agents), 2))
        here = env.snapshot()
        reward = env.advance(actions).reward
        imagined.restore(here)
        actual = imagined.advance(actions).reward[0]
        for row in range(len(env.agents)):
            imagined.restore(here)
            other = actions.copy()
            other[row] = neutral[row]
            # the neutral action maps to the neutral control to round-off
            counterfactual = imagined.advance(other).reward[row]
            np.testing.assert_allclose(reward[row], actual - counterfactual, rtol=1e-9, atol=1e-9)


def test_copies_restart_by_themselves() -> None:
    """The last observation of an ended episode is in infos; the one returned begins the next."""
    env, alone = (
        vector_env("copper_net", num_envs=2, horizon=3),
        vector_env("copper_net", num_envs=2, horizon=3),
    )
    env.reset(0)
    alone.reset(0)
    neutral = {agent: np.tile(action, (2, 1)) for agent, action in env.neutral_action.items()}
    for step in range(1, 8):
        observations, _, terminations, truncations, infos = env.step(neutral)
        expected = alone.advance(alone.stack(neutral)).observation
        ended = step % 3 == 0
        for agent in env.agents:
            assert not terminations[agent].any()
            assert (truncations[agent] == ended).all()
            assert ("final_observation" in infos[agent]) == ended
            last: NDArray[np.float32] = infos[agent]["final_observation"] if ended else observations[agent]
            np.testing.assert_array_equal(last, expected[alone.layout.slices[agent]].T)
        if ended:
            again = alone.reset()  # goes on with the streams, as the restart does
            for agent in env.agents:
                np.testing.assert_array_equal(observations[agent], again[agent])


@pytest.mark.parametrize("name", networks())
def test_others_hold_their_neutral_control(name: str) -> None:
    """A one-agent environment is the whole network with everyone else neutral."""
    agent = load_network(name).agents[-1]
    one, many = parallel_env(name, agents=[agent]), parallel_env(name)
    one.reset(seed=2)
    many.reset(seed=2)
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-1, 1, 1)
        one.step({agent: action})
        many.step({**many.neutral_action, agent: action})
        # neutral_action is float32, so the controls of the others are neutral to 1e-7
        np.testing.assert_allclose(one.state(), many.state(), rtol=1e-6, atol=1e-6)


def test_zero_throughput_is_not_best() -> None:
    """Stopping everything is good for λ, but the service fails and the mixed reward falls.

    It is compared with neutral control and, where compartments have a script, with the script.
    """
    for name in networks():
        env = vector_env(name, num_envs=2)
        stopped = rollout(env, Constant(dict.fromkeys(env.agents, -1.0)), seed=0)
        usual = rollout(env, Scripted(), seed=0)
        assert (stopped.returns.sum(axis=0) < usual.returns.sum(axis=0)).all(), name
        assert (stopped.episode_service < usual.episode_service).all(), name


def test_results_cannot_be_written_through() -> None:
    """Flows and ends are shared by all agents and by the state, so they are read-only."""
    env = vector_env("copper_net", num_envs=2)
    env.reset(seed=0)
    actions = {agent: np.zeros((2, 1)) for agent in env.agents}
    _, _, terminations, truncations, infos = env.step(actions)
    for shared in (infos["mine"]["flows"], terminations["mine"], truncations["mine"]):
        with pytest.raises(ValueError, match="read-only"):
            shared[:] = 0


def test_random_control_does_not_copy_the_start_state() -> None:
    """Actions and initial stocks come from different streams though both have the same seed."""
    env = vector_env("copper_net", num_envs=1)
    observations = env.reset(seed=7)
    controller = Random()
    controller.start(env, 7)
    drawn = np.array([action[0, 0] for action in controller.act(observations).values()]) / 2 + 0.5
    nodes = [node for node in env.network.nodes if node.initial[0] < node.initial[1]]
    low, high = np.array([node.initial for node in nodes]).T
    stock = env.physical.stock[[env.network.node_index[node.id] for node in nodes], 0]
    assert not np.isclose((stock - low) / (high - low), drawn[: len(nodes)], rtol=1e-6).any()


@pytest.mark.parametrize("options", [{"state": {}}, {"x0": 1}, 5])
def test_unknown_reset_options_are_errors(options: Any) -> None:
    """A start state under another name is not silently ignored."""
    env = parallel_env("copper_net")
    with pytest.raises(ControlError, match="reset options"):
        env.reset(seed=0, options=options)


@pytest.mark.parametrize("actions", [None, [0.0], "mine"])
def test_actions_that_are_no_mapping_are_errors(actions: Any) -> None:
    """Whatever is handed in, the error says what is wanted."""
    env, batch = parallel_env("copper_net"), vector_env("copper_net", num_envs=1)
    env.reset(seed=0)
    batch.reset(seed=0)
    for step in (env.step, batch.step):
        with pytest.raises(ControlError, match="must be a mapping"):
            step(actions)


def test_text_is_no_action() -> None:
    """Numbers in quotation marks are refused, not parsed."""
    env = parallel_env("copper_net")
    env.reset(seed=0)
    with pytest.raises(ControlError, match="agent 'refinery'"):
        env.step({agent: ["0.5"] for agent in env.agents})


def test_misspelt_options_name_the_nearest() -> None:
    """Options of the environments and of ``with_options`` are checked."""
    with pytest.raises(CirlError, match=r"unknown option 'horzon'\. Did you mean 'horizon'"):
        parallel_env("copper_net", horzon=3)
    with pytest.raises(CirlError, match=r"unknown field 'horzon'\. Did you mean 'horizon'"):
        load_network("copper_net").with_options(episode={"horzon": 3})
    with pytest.raises(CirlError, match=r"unknown group 'episod'\. Did you mean 'episode'"):
        load_network("copper_net").with_options(episod={"horizon": 3})
    with pytest.raises(CirlError, match="fixed order"):
        parallel_env("copper_net", agents={"mine", "use"})
