"""Inner physics inside a network: models advance with the stocks, give flows, rewards and observations."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from paper_classes import PAPER, trajectory
from scipy.integrate import solve_ivp

from cirl_marl import Arc, Control, ControlKind, MultiAgentVectorEnv, Network, NetworkError, Node, Role, parallel_env
from cirl_marl.compartments import model_class
from cirl_marl.compartments.digester import Digester
from cirl_marl.definitions.reader import Definition, write_network
from cirl_marl.environments.single import SingleAgentEnv
from cirl_marl.network import Floats
from cirl_marl.network.elements import Episode, Law, Objective, Observation
from cirl_marl.testing import check_parallel_env, check_vector_env
from cirl_marl.testing.nested import same_or_raise

LITRES = 1000.0
KG_PER_MMOL = 44.01e-6


def digester_network(step: float = 0.0125, horizon: int = 40) -> Network:
    """A digester of 1 m³ that emits CO₂ into the air; its agent sets the dilution."""
    digester = model_class("digester")()
    start = digester.equilibrium(0.5)
    node = Node(
        id="digester",
        initial=(50.0, 50.0),
        model=digester,
        inner=tuple((0.95 * value, 1.05 * value) for value in start),
        control=Control(kind=ControlKind.INPUT, low=0.3, neutral=0.5, high=0.7),
    )
    arc = Arc(
        id="emission", donor="digester", recipient="air", law=Law.COMPARTMENT, by="digester", rate=LITRES * KG_PER_MMOL
    )
    return Network(
        name="digestion",
        nodes=(node, Node(id="air", role=Role.ENVIRONMENT)),
        arcs=(arc,),
        episode=Episode(control_interval=0.25, horizon=horizon, solver="rk4", solver_step=step),
        mass_unit="kg",
    )


def paper_network(kind: str) -> Network:
    """The published environment of one compartment: its model alone, Euler steps of 5·10⁻⁵ of its time unit."""
    cls, paper = model_class(kind), PAPER[kind]
    low, high = paper.input_low[0], paper.input_high[0]
    node = Node(
        id="plant",
        model=cls(form="published"),
        inner=tuple((value, value) for value in paper.reference_start),
        control=Control(kind=ControlKind.INPUT, low=low, neutral=(low + high) / 2, high=high),
    )
    return Network(
        name=kind,
        nodes=(node,),
        arcs=(),
        episode=Episode(control_interval=paper.dt, solver_step=paper.dt, horizon=paper.horizon, solver="euler"),
        objective=Objective(reward="local_sum"),
        observation=Observation(mode="stocks", nodes=tuple(f"plant.{name}" for name in cls.state_names)),
        time_unit=cls.time_unit,
    )


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("transport_truck", "TransportTruck"),
        ("incinerator", "Incinerator"),
        ("microalgae_monod", "CO2MicroalgaeMonod"),
        ("microalgae_droop", "CO2MicroalgaeDroop"),
    ],
)
def test_published_environments_as_the_one_agent_case(kind: str, name: str) -> None:
    """The general machinery, given the published model, bounds and Euler step, reproduces the published trajectory."""
    actions, states, rewards = trajectory(name)
    env = SingleAgentEnv(paper_network(kind))
    env.reset(seed=0)
    steps = min(len(actions), env.network.episode.horizon)
    for t in range(steps):
        _, reward, terminated, truncated, info = env.step(np.array([actions[t]]))
        np.testing.assert_allclose(info["state"], states[t + 1], rtol=1e-9, atol=1e-9)
        assert reward == pytest.approx(rewards[t], rel=1e-9, abs=1e-8)
        assert not terminated
        assert truncated == (t + 1 == env.network.episode.horizon)


def final(network: Network, dilution: float) -> Floats:
    """Return stocks and inner states after two days at a constant dilution."""
    env = MultiAgentVectorEnv(network, num_envs=1)
    start = network.nodes[0].model.equilibrium(0.5)  # type: ignore[union-attr]
    names = [f"digester.{name}" for name in network.nodes[0].model.state_names]  # type: ignore[union-attr]
    env.reset(seed=0, options={"initial_state": dict(zip(names, start * 1.1, strict=True))})
    action = np.array([[(dilution - 0.5) / 0.2]])
    for _ in range(8):
        env.advance(action)
    return np.concatenate([env.physical.stock[:-1, 0], env.physical.inner[:, 0]])


@pytest.mark.medium
def test_runge_kutta_has_order_four_and_the_right_limit() -> None:
    """Stocks and inner states, taken together, converge with order 4 to scipy's solution."""
    network = digester_network()
    digester: Any = network.nodes[0].model
    start = np.concatenate([[50.0, 0.0], digester.equilibrium(0.5) * 1.1])
    inputs = np.array([[0.6]])

    def slope(_: float, y: Floats) -> Floats:
        inner = y[2:, None]
        emitted = LITRES * KG_PER_MMOL * digester.outflow(inner, inputs)[0]
        return np.concatenate([[-emitted, emitted], digester.derivative(inner, inputs)[:, 0]])

    exact = solve_ivp(slope, (0, 2), start, method="Radau", rtol=1e-11, atol=1e-11).y[:, -1]
    errors = [np.abs(final(digester_network(step), 0.6) - exact).max() for step in (0.0125, 0.00625, 0.003125)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 4.0, atol=0.35)
    assert errors[-1] < 1e-5


def test_model_gives_flow_reward_and_observation() -> None:
    """The emission at equilibrium is the published 66.96 mmol/(L d); mass is conserved; the agent sees its states."""
    env = parallel_env(digester_network(), reward="local")
    names = [f"digester.{name}" for name in model_class("digester").state_names]
    start = model_class("digester")().equilibrium(0.5)
    env.reset(seed=0, options={"initial_state": dict(zip(names, start, strict=True))})
    before = env.state()[:2].sum()
    observation, rewards, _, _, infos = env.step({"digester": [0.0]})
    emitted = infos["digester"]["flows"][0] / (LITRES * KG_PER_MMOL)
    assert emitted == pytest.approx(66.96, abs=0.005)
    assert rewards["digester"] == pytest.approx(-emitted, rel=1e-6)
    assert infos["digester"]["circularity"] == pytest.approx(-infos["digester"]["flows"][0], rel=1e-6)
    assert env.state()[:2].sum() == pytest.approx(before, rel=1e-15)
    seen = dict(zip(env.layout.names["digester"], observation["digester"], strict=True))
    np.testing.assert_allclose([seen[name] for name in names], start, rtol=1e-4)


def test_empty_store_sends_no_more_than_it_holds() -> None:
    """A model that asks for more than its node holds gets what is there; stocks stay non-negative."""
    network = digester_network()
    node = replace(network.nodes[0], initial=(0.5, 0.5))
    env = MultiAgentVectorEnv(replace(network, nodes=(node, network.nodes[1])), num_envs=3)
    env.reset(seed=0)
    for _ in range(4):
        env.step({"digester": np.ones((3, 1))})
    stock = env.physical.stock[:-1]
    assert (stock >= 0).all()
    assert (stock[0] < 1e-9).all()
    np.testing.assert_allclose(stock.sum(axis=0), 0.5, rtol=1e-14)


@pytest.mark.medium
def test_environments_with_inner_physics_conform() -> None:
    """The conformance suite, batch equality and bit-exact snapshots hold with inner states too."""
    network = digester_network(horizon=6)
    check_parallel_env(lambda: parallel_env(network))
    check_vector_env(lambda: MultiAgentVectorEnv(network, num_envs=3))
    batch, lone = MultiAgentVectorEnv(network, num_envs=3), MultiAgentVectorEnv(network, num_envs=1)
    batch.reset(seed=5)
    lone.reset(seed=7)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (3, 3, 1))
    for action in actions:
        shown = batch.step({"digester": action})[0]
        lone.step({"digester": action[2:]})
    assert np.array_equal(batch.state()[2:], lone.state())
    saved = pickle.loads(pickle.dumps(batch.snapshot()))
    first = [batch.advance(action.T).reward for action in actions]
    same_or_raise(shown, batch.restore(saved), "observations of the snapshot and after going back")
    assert all(np.array_equal(a, batch.advance(b.T).reward) for a, b in zip(first, actions, strict=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class MeteredDigester(Digester):
    """A digester that measures what flows through it, which is its input."""

    measure_names: ClassVar[tuple[str, ...]] = ("dilution_per_day",)

    def measures(self, state: Floats, inputs: Floats) -> Floats:
        """Return the input, shape (1, B)."""
        return inputs


def test_going_back_shows_what_was_measured() -> None:
    """Also where that depends on the last controls, and whatever else the environment that goes back observes."""
    network = digester_network(horizon=2)
    digester, air = network.nodes
    network = replace(network, nodes=(replace(digester, model=MeteredDigester()), air))
    env, wide = MultiAgentVectorEnv(network, num_envs=2), MultiAgentVectorEnv(network, num_envs=2, observe="full")
    place = env.observation_names["digester"].index("digester.dilution_per_day")
    shown, expected = env.reset(seed=0), wide.reset(seed=0)
    for action, dilution in ((1.0, 0.7), (-0.5, 0.4), (0.5, 0.6), (0.0, 0.5)):
        snapshot = env.snapshot()
        actions = {"digester": np.full((2, 1), action)}
        env.step(actions)
        same_or_raise(shown, env.restore(snapshot), "observations of the snapshot and after going back")
        same_or_raise(shown, env.observations(), "observations after going back and asked for")
        same_or_raise(expected, wide.restore(snapshot), "observations of the snapshot and after going back")
        outcome = env.advance(env.stack(actions))
        np.testing.assert_allclose(outcome.observation[place], dilution, rtol=1e-6)
        env.restore(snapshot)
        shown, expected = env.step(actions)[0], wide.step(actions)[0]


def test_definition_with_a_model_reads_back(tmp_path: Path) -> None:
    """A network with inner physics is written and read to the last bit."""
    network = digester_network()
    write_network(network, tmp_path / "digestion.toml")
    found = Definition(tmp_path / "digestion.toml").network()
    assert (found.nodes, found.arcs, found.episode) == (network.nodes, network.arcs, network.episode)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"episode": Episode(solver="exact")}, "solver 'exact' knows no continuous inner physics"),
        ({"episode": Episode(solver="rk4")}, "solver 'rk4' needs a positive solver_step"),
        ({"episode": Episode(solver="rk4", solver_step=0.3)}, "not a whole number of solver steps"),
    ],
)
def test_settings_that_do_not_fit_are_named(change: dict[str, Episode], message: str) -> None:
    """A solver that cannot take the model is an error."""
    with pytest.raises(NetworkError, match=message):
        replace(digester_network(), **change)  # type: ignore[arg-type]


def test_faults_of_models_are_named() -> None:
    """A missing range, an input without a model, and a flow from a model that gives none are errors."""
    network = digester_network()
    digester, air = network.nodes
    with pytest.raises(NetworkError, match="5 initial ranges for the inner states"):
        replace(network, nodes=(replace(digester, inner=digester.inner[1:]), air))
    with pytest.raises(NetworkError, match=r"control\.kind 'input' needs a model with inputs"):
        replace(network, nodes=(digester, replace(air, control=digester.control)))
    with pytest.raises(NetworkError, match=r"unknown compartment at this arc .* 'ar'"):
        replace(network, arcs=(replace(network.arcs[0], by="ar"),))
