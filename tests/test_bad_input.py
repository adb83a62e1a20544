"""What the environments refuse, by name and with the nearest match: actions, options, starts, seeds, snapshots."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from functools import partial
from inspect import isfunction, signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networkx import NetworkXError
from numpy.typing import NDArray
from small_networks import constant

import cirl_marl
from cirl_marl import (
    Arc,
    CirlError,
    ControlError,
    MultiAgentVectorEnv,
    Network,
    Neutral,
    Node,
    load_network,
    parallel_env,
    resume,
    rollout,
    single_agent_env,
    train,
    vector_env,
)

AGENTS = ("mine", "use_to_collection")


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ({"mine": [np.nan], "use_to_collection": [0.0]}, "'mine'.* is nan"),
        ({"mine": [0.0], "use_to_collection": [np.inf]}, "'use_to_collection'.* is inf"),
        ({"mine": [0.0], "use_to_collection": [1.5]}, r"'use_to_collection'.* is 1.5.*\[-1, 1\]"),
        ({"mine": [1.0000005], "use_to_collection": [np.nan]}, "'use_to_collection'.* is nan"),
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
        ({"agents": ["landfill"]}, "'landfill' has no control, so that it cannot act"),
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
        ({"num_envs": 10**12}, "num_envs must be at most 16,777,216, got 1,000,000,000,000"),
    ],
)
def test_bad_options(options: dict[str, Any], message: str) -> None:
    """A wrong option is an error that gives the nearest valid one."""
    with pytest.raises(CirlError, match=message):
        MultiAgentVectorEnv("copper_net", **options)


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


@pytest.mark.parametrize(
    "seed", [-1, [1, 2, 3], [1, -1], 1.5, "one", True, [0, True], np.array(3), np.zeros((2, 1), int)]
)
def test_bad_seeds(seed: Any) -> None:
    """A seed is a non-negative integer, or one for each copy."""
    with pytest.raises(ControlError, match="seed"):
        vector_env("copper_net", num_envs=2).reset(seed)


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
        vector_env("copper_net", num_envs=2, horizon=10),
    ):
        with pytest.raises(ControlError, match="snapshot"):
            other.restore(snapshot)


def test_snapshot_of_another_definition() -> None:
    """The same names with other rates are another network."""
    network = load_network("copper_net")
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(0)
    faster = tuple(replace(arc, rate=2 * constant(arc.rate)) for arc in network.arcs)
    with pytest.raises(ControlError, match="another definition of network 'copper_net'"):
        MultiAgentVectorEnv(replace(network, arcs=faster), num_envs=1).restore(env.snapshot())


@pytest.mark.parametrize(
    ("network", "scenario", "given", "message"),
    [
        ("net_zero", "droop", {"microalgae.nutrient_umol_l": -5.0}, r"holds for \[0, inf\]"),
        ("net_zero", "default", {"digester.substrate_g_l": -7.1}, r"holds for \[0, inf\]"),
        ("solids_net", "reacher", {"incinerator.freeboard_degc": -400.0}, r"holds for \[-272\.15, inf\]"),
        ("solids_net", "reacher", {"sorter.target_x_m": 0.1}, r"the state of its simulator, all \d+ entries together"),
    ],
)
def test_states_beyond_the_equations(network: str, scenario: str, given: dict[str, float], message: str) -> None:
    """A start for which a model does not hold, or that its simulator would not take over, is refused."""
    env = MultiAgentVectorEnv(network, num_envs=2, scenario=scenario)
    with pytest.raises(ControlError, match=message):
        env.reset(seed=0, options={"initial_state": given})


def test_a_whole_state_of_a_simulator_is_a_start() -> None:
    """What one robot was in, another goes on from, bit for bit."""
    env = MultiAgentVectorEnv("solids_net", num_envs=1, scenario="reacher")
    names = [name for name in env.state_names if name.startswith("sorter.")]
    env.reset(seed=3)
    begun = dict(zip(env.state_names, env.state()[0], strict=False))
    after = env.step(env.neutral_action)[0]["sorter"]
    env.reset(seed=4, options={"initial_state": {name: begun[name] for name in names}})
    again = env.step(env.neutral_action)[0]["sorter"]
    np.testing.assert_array_equal(after, again)


def test_mass_is_counted_in_each_copy() -> None:
    """What one copy holds here and another there is not added up."""
    ends = Node(id="a", initial=(0.0, 100.0)), Node(id="b")
    env = MultiAgentVectorEnv(
        Network(name="two", nodes=ends, arcs=(Arc(id="f", donor="a", recipient="b", rate=0.1),)), num_envs=2
    )
    env.reset(0, options={"initial_state": {"a": [100.0, 0.0], "b": [0.0, 100.0]}})
    np.testing.assert_array_equal(env.physical.stock[:2], [[100.0, 0.0], [0.0, 100.0]])
    with pytest.raises(ControlError, match="150 kg in all"):
        env.reset(0, options={"initial_state": {"a": [100.0, 0.0], "b": [50.0, 100.0]}})


def test_scenario_after_options_is_an_error() -> None:
    """Options would be lost with the scenario they were set in."""
    network = load_network("copper_net").with_options(objective={"reward": "team"})
    with pytest.raises(CirlError, match="choose it first"):
        MultiAgentVectorEnv(network, scenario="paper")
    assert MultiAgentVectorEnv(network).reward_mode == "team"


def test_what_is_shared_cannot_be_written_to() -> None:
    """Neither a network of the catalogue nor an array that all agents get."""
    network = load_network("carbo_net")
    with pytest.raises(ValueError, match="read-only"):
        network.sustainability[:] = 0.0
    with pytest.raises(NetworkXError, match="Frozen"):
        network.graph.clear()
    env = MultiAgentVectorEnv(network, num_envs=2)
    env.reset(0)
    infos = env.step({agent: np.zeros((2, 1)) for agent in env.agents})[4]
    for shared in ("circularity", "service_level", "flows"):
        with pytest.raises(ValueError, match="read-only"):
            infos[env.agents[0]][shared][:] = 0.0


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
    with pytest.raises(CirlError, match=r"unknown option 'horzon'\. Did you mean 'horizon'.*agent, .*legacy_episode"):
        single_agent_env("copper_net", "mine", horzon=3)
    with pytest.raises(CirlError, match=r"agent must be the name of one agent, got \['mine'\]"):
        single_agent_env("copper_net", ["mine"])  # type: ignore[arg-type]
    for make in (parallel_env, vector_env, single_agent_env):
        with pytest.raises(CirlError, match=r"network must be a name of the catalogue, a file or a Network, got 3"):
            make(3)  # type: ignore[arg-type]
    weighed = MultiAgentVectorEnv("copper_net", circularity_weight=np.float32(0.5))  # type: ignore[arg-type]
    assert weighed.network.objective.circularity_weight == 0.5
    with pytest.raises(CirlError, match=r"unknown field 'horzon'\. Did you mean 'horizon'"):
        load_network("copper_net").with_options(episode={"horzon": 3})
    with pytest.raises(CirlError, match=r"unknown group 'episod'\. Did you mean 'episode'"):
        load_network("copper_net").with_options(episod={"horizon": 3})
    with pytest.raises(CirlError, match="fixed order"):
        parallel_env("copper_net", agents={"mine", "use"})


def test_rollouts_of_something_else() -> None:
    """A PettingZoo view in the place of the environment, a name or a class in that of the controller."""
    with pytest.raises(ControlError, match=r"takes what vector_env\(.*returns, not NetworkParallelEnv"):
        rollout(parallel_env("copper_net"), Neutral())
    for controller in ("neutral", Neutral):
        with pytest.raises(ControlError, match=r"takes a controller, such as Neutral\(\).* not .*[nN]eutral"):
            rollout(vector_env("copper_net", num_envs=1), controller)  # type: ignore[arg-type]


def test_devices_that_are_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Are refused before a run is begun: one that torch does not know, and one that this machine lacks."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    for device, hint in (("cpuu", r"Did you mean 'cpu'\? "), ("cuda:77", "")):
        with pytest.raises(CirlError, match=rf"unknown device of this machine '{device}'\. {hint}Known: cpu"):
            train("copper_net", steps=100, device=device, directory=tmp_path / "run")
        with pytest.raises(CirlError, match="unknown device"):
            resume(tmp_path / "run", device=device)
    assert not any(tmp_path.iterdir())


WHOLE: Any = object()


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: cirl_marl.write_network(WHOLE, "x.toml"), "network must be a Network, got <object"),
        (lambda: cirl_marl.indicators(WHOLE, WHOLE), "network must be a Network"),
        (lambda: cirl_marl.interval_ends(WHOLE), "network must be a Network"),
        (lambda: cirl_marl.gradient(WHOLE, WHOLE), "env must be a MultiAgentVectorEnv"),
        (lambda: cirl_marl.improve_schedule(WHOLE, WHOLE), "env must be a MultiAgentVectorEnv"),
        *(
            (lambda call=call: call(WHOLE), "bound must be a Bound")
            for call in (cirl_marl.improve_plan, cirl_marl.smooth_plan, cirl_marl.simulate_plan)
        ),
        (lambda: cirl_marl.write_package("x", WHOLE), "simulation must be a Simulation"),
        (lambda: cirl_marl.write_iamc("x.csv", [WHOLE]), "each of simulations must be a Simulation"),
        *(
            (lambda call=call: call(WHOLE), "network must be a name of the catalogue, a file or a Network")
            for call in (
                cirl_marl.load_network,
                cirl_marl.bound,
                cirl_marl.explain,
                cirl_marl.levers,
                cirl_marl.vector_env,
                cirl_marl.single_agent_env,
                cirl_marl.train,
            )
        ),
        *(
            (lambda call=call, path=path: call(path), f"is no path: {reason}")
            for call in (
                cirl_marl.Trained,
                cirl_marl.evaluate,
                cirl_marl.plan,
                cirl_marl.resume,
                cirl_marl.sweep,
                partial(cirl_marl.Team.load, make_env=dict),
            )
            for path, reason in ((None, ""), (3, ""), ("x\0", "embedded null"), ("x" * 9999, "File name too long"))
        ),
        *(
            (lambda call=call: call("[nodes.mine]\n" + "# copper\n" * 999 + "# .toml"), "no path: File name too long")
            for call in (cirl_marl.load_network, partial(cirl_marl.train, "copper_net"))
        ),
        *(
            (lambda option=option: cirl_marl.train("copper_net", **option), said)
            for option, said in (
                ({"min_service": "0.9"}, "min_service must be a number in [0, 1], got '0.9'"),
                ({"min_service": {"society": 0.9}}, "min_service must be a number in [0, 1], got {"),
                ({"min_service": math.nan}, "min_service must be a number in [0, 1], got nan"),
                ({"checkpoint_every": "5"}, "checkpoint_every must be a number of at least 0, got '5'"),
                ({"circularity_weight": np.complex64(0.5)}, "circularity_weight must be a number in [0, 1]"),
                ({"callbacks": [WHOLE]}, "callbacks must be a Mapping"),
                ({"device": None}, "unknown device of this machine 'None'"),
            )
        ),
        (lambda: setattr(cirl_marl.vector_env("copper_net"), "service_factors", "x"), "service_factors is 'x'"),
        (lambda: setattr(cirl_marl.vector_env("copper_net"), "account_charges", "x"), "charges is 'x'"),
        (lambda: cirl_marl.infer(WHOLE, []), "network must be a name of the catalogue"),
        (lambda: cirl_marl.account_front(WHOLE, "ab"), "network must be a name of the catalogue"),
        (lambda: cirl_marl.pareto_front(WHOLE, directory="x"), "network must be a name of the catalogue"),
        (lambda: cirl_marl.compare(network=WHOLE), "network must be a name of the catalogue"),
    ],
)
def test_arguments_of_another_type(call: Any, said: str) -> None:
    """Are named, with what was expected, by each public function that takes an object of this library."""
    with pytest.raises(CirlError) as refused:
        call()
    assert said in str(refused.value)


def test_a_network_is_itself() -> None:
    """What names a network may be one, under a scenario of it."""
    network = cirl_marl.load_network("copper_net")
    assert cirl_marl.load_network(network) is network
    assert cirl_marl.load_network(network, scenario="paper").scenario_name == "paper"


def test_every_path_may_be_a_text() -> None:
    """Of every public function: who has a ``Path`` of it is no exception."""
    for name in cirl_marl.__all__:
        member = getattr(cirl_marl, name)
        if isfunction(member):
            annotations = signature(member).parameters.values()
            pathlike = [str(one.annotation) for one in annotations if "Path" in str(one.annotation)]
            assert all("str | Path" in annotation for annotation in pathlike), name


class Unconvertible:
    """What NumPy cannot make an array of, as a tensor that requires a gradient."""

    def __array__(self, dtype: object = None, copy: object = None) -> NDArray[np.float32]:
        """Refuse, as PyTorch does."""
        raise RuntimeError("Can't call numpy() on Tensor that requires grad.\nMore.")


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.ma.masked_array([0.5], mask=[True]), "is masked in part"),
        (Unconvertible(), "is no array of numbers: Can't call numpy.. on Tensor that requires grad.$"),
    ],
)
def test_actions_that_are_no_numbers(action: Any, message: str) -> None:
    """A masked entry is none, and what NumPy refuses is refused with its reason, in both views."""
    for env, shown in ((parallel_env("copper_net"), action), (vector_env("copper_net", 1), _in_batch(action))):
        env.reset(seed=0)
        actions = {agent: np.zeros(shape) for agent, shape in _shapes(env).items()}
        env.step({**actions, "mine": np.ma.masked_array(actions["mine"], mask=False)})
        with pytest.raises(ControlError, match=f"action of agent 'mine' {message}"):
            env.step({**actions, "mine": shown})


def test_actions_of_more_than_double_precision() -> None:
    """They do what the nearest numbers in double precision do, inside of compartments too."""
    rewards = []
    for precision in (np.longdouble, float):
        env = parallel_env("net_zero")
        env.reset(seed=0)
        rewards.append(env.step({agent: np.full(shape, 0.1, precision) for agent, shape in _shapes(env).items()})[1])
    assert rewards[0] == rewards[1]


def _in_batch(action: Any) -> Any:
    return action[None] if isinstance(action, np.ma.MaskedArray) else action


def _shapes(env: Any) -> dict[str, tuple[int, ...]]:
    copies = (env.num_envs,) if isinstance(env, MultiAgentVectorEnv) else ()
    return {agent: (*copies, *space.shape) for agent, space in env.action_spaces.items()}


def test_messages_stay_readable() -> None:
    """What a file has too much of is not repeated; the beginning and the end of a message, with the remedy, stay."""
    error = CirlError(f"{'x' * 180_000}: the end\nsecond line")
    first, second = str(error).split("\n")
    assert len(first) <= 1200 and first.startswith("xxx") and first.endswith("the end") and "180009 characters" in first
    assert second == "second line"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
