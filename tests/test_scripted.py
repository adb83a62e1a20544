"""Scripted control: bounded, blind to the batch, neutral where there is no script, and worth having."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_networks import PLAYED

from cirl_marl import CirlError, ControlError, MultiAgentVectorEnv, load_network
from cirl_marl.compartments import model_class, models
from cirl_marl.compartments.incinerator import Incinerator
from cirl_marl.controllers import Neutral, ScriptController
from cirl_marl.controllers.rollout import rollout
from cirl_marl.controllers.scripted import LOWER_M, SCRIPTS, UPPER_M, _joint_angles, incinerator, truck
from cirl_marl.network import Floats

CATALOGUE = PLAYED


def script_of(model: Any) -> bool:
    """Return whether there is a script for a model."""
    return getattr(model, "kind", None) in SCRIPTS or getattr(model, "kind", None) == "sorting_station"


@pytest.mark.parametrize(("name", "scenario"), CATALOGUE)
def test_agents_without_a_script_are_neutral(name: str, scenario: str) -> None:
    """The others act, if not at once then somewhere in the observation space."""
    env = MultiAgentVectorEnv(name, num_envs=3, scenario=scenario)
    observations = env.reset(0)
    controller, neutral = ScriptController(), Neutral()
    controller.start(env, 0)
    neutral.start(env, 0)
    rng = np.random.default_rng(0)
    wide = {agent: rng.normal(0.0, 500.0, seen.shape).astype(np.float32) for agent, seen in observations.items()}
    found = controller.act(wide)
    assert list(found) == list(env.agents)
    for agent, action in neutral.act(observations).items():
        compartment = env.network.compartments[agent]
        if compartment.rule is not None:
            assert agent in controller.script_agents
            continue
        is_scripted = script_of(compartment.model)
        assert (found[agent] != action).any() == (agent in controller.script_agents) == is_scripted, agent
        assert found[agent].shape == action.shape


def test_every_script_has_a_model() -> None:
    """By the kind of the model that it drives, and its inputs in number."""
    assert set(SCRIPTS) <= set(models())
    assert {model_class(kind).kind for kind in SCRIPTS} == set(SCRIPTS)


finite = st.floats(-1e6, 1e6, width=32)


@given(data=st.data(), scenario=st.sampled_from(["default", "reacher"]))
def test_actions_are_bounded(data: st.DataObject, scenario: str) -> None:
    """Whatever is seen: in [−1, 1], no NaN, and accepted by the environment."""
    env = ENVS[scenario]
    controller = ScriptController()
    controller.start(env, 0)
    seen = {
        agent: np.array(data.draw(st.lists(finite, min_size=2 * n, max_size=2 * n)), np.float32).reshape(2, n)
        for agent, n in ((agent, len(space.low)) for agent, space in env.observation_spaces.items())
    }
    for agent, action in controller.act(seen).items():
        assert action.shape == (2, *env.action_spaces[agent].shape)
        assert ((action >= -1.0) & (action <= 1.0)).all()
    env.stack(controller.act(seen))


ENVS = {
    scenario: MultiAgentVectorEnv("solids_net", num_envs=2, scenario=scenario) for scenario in ("default", "reacher")
}


@pytest.mark.parametrize("scenario", ["default", "reacher"])
def test_copies_do_not_notice_each_other(scenario: str) -> None:
    """The action of a copy is a function of what that copy sees, and the script keeps no memory."""
    env = MultiAgentVectorEnv("solids_net", num_envs=3, scenario=scenario)
    alone = MultiAgentVectorEnv("solids_net", num_envs=1, scenario=scenario)
    many, one = ScriptController(), ScriptController()
    many.start(env, 0)
    one.start(alone, 0)
    observations = env.reset(4)
    for _ in range(60):
        actions = many.act(observations)
        again = many.act(observations)
        for i in (2, 0, 1):
            lone = one.act({agent: seen[[i]] for agent, seen in observations.items()})
            for agent, action in lone.items():
                np.testing.assert_array_equal(action[0], actions[agent][i])
                np.testing.assert_array_equal(again[agent], actions[agent])
        observations = env.step(actions)[0]


def test_held_agents_do_not_listen() -> None:
    """A constant is held for an agent with a script and for one without; unknown agents and values are errors."""
    env = MultiAgentVectorEnv("solids_net", num_envs=2)
    observations = env.reset(0)
    controller = ScriptController({"truck": 0.25})
    controller.start(env, 0)
    np.testing.assert_array_equal(controller.act(observations)["truck"], 0.25)
    free = ScriptController()
    free.start(env, 0)
    np.testing.assert_array_equal(controller.act(observations)["sorter"], free.act(observations)["sorter"])
    with pytest.raises(ControlError, match="Did you mean 'truck'"):
        ScriptController({"truk": 0.0}).start(env, 0)
    with pytest.raises(ControlError, match=r"'truck' is 1\.5"):
        ScriptController({"truck": 1.5}).start(env, 0)


def test_started_again_it_serves_another_network() -> None:
    """Nothing of the first network is left."""
    controller = ScriptController()
    controller.start(ENVS["default"], 0)
    env = MultiAgentVectorEnv("copper_net", num_envs=2)
    controller.start(env, 0)
    assert set(controller.act(env.reset(0))) == set(env.agents)


def test_what_is_not_seen_is_named() -> None:
    """An agent that observes stocks alone cannot follow its script, and the error says what is missing."""
    network = load_network("solids_net").with_options(observation={"nodes": ("reservoir", "sorter"), "mode": "stocks"})
    env = MultiAgentVectorEnv(network, num_envs=1)
    controller = ScriptController()
    controller.start(env, 0)
    with pytest.raises(ControlError, match="scripted control of 'sorter' needs to see its state 'grip_x'"):
        controller.act(env.reset(0))


@pytest.mark.parametrize("observe", ["neighbours", "full"])
def test_wider_observations_change_nothing(observe: str) -> None:
    """The script reads its own states by name, wherever they are."""
    usual, wide = (
        MultiAgentVectorEnv("solids_net", num_envs=2),
        MultiAgentVectorEnv("solids_net", num_envs=2, observe=observe),
    )
    actions = []
    for env in (usual, wide):
        controller = ScriptController()
        controller.start(env, 0)
        actions.append(controller.act(env.reset(3)))
    for agent, action in actions[0].items():
        np.testing.assert_array_equal(action, actions[1][agent])


def test_reacher_s_kinematics() -> None:
    """The angles put the tip where it is wanted, the elbow on the side where it is, for all points within reach."""
    rng = np.random.default_rng(0)
    radius, angle = rng.uniform(0.03, 0.2, 500), rng.uniform(-np.pi, np.pi, 500)
    x, y, second = radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-3, 3, 500)
    shoulder, elbow = _joint_angles(x, y, second)
    tip_x = UPPER_M * np.cos(shoulder) + LOWER_M * np.cos(shoulder + elbow)
    tip_y = UPPER_M * np.sin(shoulder) + LOWER_M * np.sin(shoulder + elbow)
    np.testing.assert_allclose(np.hypot(tip_x - x, tip_y - y), 0.0, atol=1e-12)
    np.testing.assert_array_equal(np.sign(elbow), np.where(second >= 0, 1.0, -1.0))


def test_truck_and_incinerator_pull_the_right_way() -> None:
    """Towards the destination, against the speed; more heat is taken where it is hotter."""
    seen = {"position_m": np.array([0.0, 10.0, 10.0]), "destination_m": np.array([10.0, 0.0, 10.0])}
    force = truck(seen | {"speed_m_s": np.array([0.0, 0.0, 1.0])})
    assert force.shape == (1, 3)
    assert force[0, 0] == -force[0, 1] > 0.0
    assert force[0, 2] < 0.0
    heat = incinerator({"freeboard_degc": np.array([900.0, 1000.0, 1100.0])}, Incinerator())[0]
    assert (np.diff(heat) > 0.0).all()


@pytest.mark.slow
@pytest.mark.medium
def test_the_incinerator_s_script_knows_its_set_point() -> None:
    """It holds what its model asks for, to some degrees."""
    base = load_network("solids_net", scenario="reacher")
    for target in (900.0, 1000.0):
        model = Incinerator(target_degc=target)
        nodes = tuple(replace(each, model=model) if each.id == "incinerator" else each for each in base.nodes)
        env = MultiAgentVectorEnv(replace(base, nodes=nodes), num_envs=1, horizon=2000)
        run = rollout(env, ScriptController({"sorter": 0.0}), seed=6)
        assert inside(env, "incinerator.freeboard_degc", run)[-1] == pytest.approx(target, abs=30.0)


def inside(run_of: MultiAgentVectorEnv, name: str, run: Any) -> Floats:
    """Return a visible inner state of the first copy over time, shape (steps,)."""
    names = [run_of.dynamics.inner.names[row] for row in run_of.dynamics.inner.visible]
    values: Floats = run.inner[:, names.index(name)]
    return values


@pytest.mark.slow
def test_scripts_are_worth_having() -> None:
    """The truck brings 3 items in 4 s and rests at home; from half-way the freeboard is nearer to 1000 °C."""
    env = MultiAgentVectorEnv("solids_net", num_envs=1, scenario="reacher")
    scripted, neutral = (
        rollout(env, controller, seed=6) for controller in (ScriptController({"sorter": 0.0}), Neutral())
    )
    aboard = inside(env, "truck.destination_m", scripted) > 0.0
    trips = np.diff(np.flatnonzero(np.diff(aboard.astype(int))))[::2] * 0.02
    assert len(trips) == 2
    assert (trips < 4.0).all()
    assert abs(inside(env, "truck.position_m", scripted)[-1]) < 0.5
    assert inside(env, "truck.position_m", scripted).max() < 10.6, "drove past the incinerator"
    worst = [np.abs(inside(env, "incinerator.freeboard_degc", run) - 1000.0)[700:].max() for run in (scripted, neutral)]
    assert worst[0] < min(0.25 * worst[1], 20.0)
    assert (scripted.returns.sum(axis=0) > neutral.returns.sum(axis=0)).all()


def test_an_unknown_kind_has_no_script() -> None:
    """A model of another kind is left neutral, and the registry says so for a kind that does not exist."""
    assert "transport_truck" not in SCRIPTS
    with pytest.raises(CirlError, match="Did you mean 'reacher'"):
        model_class("reachr")
