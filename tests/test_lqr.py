"""LQR of networks: published gains and settling times, the system that it reads off, holding, bounds, refusals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov

from cirl_marl import (
    Arc,
    CirlError,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    Node,
    load_network,
)
from cirl_marl.controllers import LQR, LinearSystem
from cirl_marl.controllers.rollout import rollout
from cirl_marl.network import Floats
from cirl_marl.network.series import Series

MEASURED = ("urban_air",)


def started(name: str = "carbo_net", scenario: str | None = "paper", **options: Any) -> tuple[LQR, MultiAgentVectorEnv]:
    """Return a controller that was started in the initial state of a network, and the environment."""
    env = MultiAgentVectorEnv(name, num_envs=1, scenario=scenario)
    env.reset(0)
    controller = LQR(**options)
    controller.start(env, 0)
    return controller, env


def closed_loop(name: str, **options: Any) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return A − BKC, x(0), x_e, u_e and −KC of the continuous closed loop under a started controller."""
    controller, env = started(name, **options)
    system = controller.system
    rows = [system.states.index(node) for node in controller.outputs or system.states]
    feedback = np.zeros((len(system.inputs), len(system.states)))
    feedback[:, rows] = -controller.gain
    start = env.physical.stock[[env.network.node_index[node] for node in system.states], 0]
    return (system.A + system.B @ feedback, start, *system.equilibrium(), feedback)


def sampled(closed: Floats, distance: Floats, until: float, step: float) -> Floats:
    """Return the exact distances to the equilibrium every ``step``, shape (times, states)."""
    propagator, path = expm(closed * step), [distance]
    for _ in range(round(until / step)):
        path.append(propagator @ path[-1])
    return np.array(path)


def test_published_full_state_gain() -> None:
    """CarboNet, Q = I and R = 1: gain, first row of the closed loop, eigenvalues, and the first capture."""
    controller, _ = started()
    closed, _, stocks, inputs, _ = closed_loop("carbo_net")
    assert controller.system.states == ("urban_air", "vehicles", "heaters", "adjacent_air")
    np.testing.assert_allclose(controller.gain, [[-0.93984418, -0.66695025, -0.92842023, -0.6481119]], atol=5e-9)
    np.testing.assert_allclose(closed[0], [-1.13984418, -0.16695025, -0.42842023, -0.5481119], atol=5e-9)
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(closed)), [-1.0208, -0.7, -0.4, -0.2191], atol=5e-5)
    np.testing.assert_allclose(stocks, [637.2, 0.0, 0.0, 1274.4], rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(inputs, [0.0], atol=1e-9)
    assert controller.demand()[0, 0] == pytest.approx(1226.0, abs=0.5)


def test_published_output_feedback() -> None:
    """CarboNet, y = x1, Q = CᵀC, R = 1.

    With κ = −K the fixed point is, in closed form, the positive root of κ³ + κ²/2 − κ − 1/10 = 0: P of the closed loop
    [[−0.2 − κ, 0.1], [0.2, −0.1]] has P11 = (1 + κ²)(det + 0.1²)/(−2·tr·det) and has to equal κ. The published figure
    lies 1.1e-11 from it.
    """
    controller, _ = started(outputs=MEASURED)
    closed = closed_loop("carbo_net", outputs=MEASURED)[0]
    (root,) = (each.real for each in np.roots([1.0, 0.5, -1.0, -0.1]) if each.real > 0)
    assert controller.gain[0, 0] == pytest.approx(-root, abs=1e-13)
    assert controller.gain[0, 0] == pytest.approx(-0.837174938693166, abs=1.2e-11)
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(closed)), [-1.0581, -0.7, -0.4, -0.0791], atol=5e-5)
    assert controller.demand()[0, 0] == pytest.approx(232.9, abs=0.05)


@pytest.mark.parametrize(("outputs", "days"), [(None, (24.4, 23.5)), (MEASURED, (42.2, 62.0))])
def test_published_settling_times(outputs: tuple[str, ...] | None, days: tuple[float, float]) -> None:
    """Both tropospheres stay within 1 % of their set-points from the published days on."""
    closed, start, goal, _, _ = closed_loop("carbo_net", outputs=outputs)
    path = np.abs(sampled(closed, start - goal, 100.0, 0.01))
    for row, day in zip((0, 3), days, strict=True):
        last = 0.01 * np.flatnonzero(path[:, row] > 0.01 * goal[row])[-1]
        assert last == pytest.approx(day, abs=0.05)


def test_published_extremes_of_carbo_net() -> None:
    """Full state takes the city's air down to 203 t at 2.7 d; output feedback captures most, 263.9 t/d, at 0.73 d."""
    closed, start, goal, _, _ = closed_loop("carbo_net")
    air = goal[0] + sampled(closed, start - goal, 20.0, 0.01)[:, 0]
    assert air.min() == pytest.approx(203.0, abs=0.5)
    assert 0.01 * air.argmin() == pytest.approx(2.7, abs=0.05)
    closed, start, goal, _, feedback = closed_loop("carbo_net", outputs=MEASURED)
    capture = (sampled(closed, start - goal, 20.0, 0.01) @ feedback.T)[:, 0]
    assert capture.max() == pytest.approx(263.9, abs=0.05)
    assert 0.01 * capture.argmax() == pytest.approx(0.73, abs=0.01)


def test_copper_net() -> None:
    """Q = I, R = 1, u_e = 1 kt/d: gain, range of the collection, and costs over 150 d with and without feedback.

    The figure to compare with, 4.613e6 against 4.744e6 open loop, is the states' share; inputs add 1.8e4.
    """
    closed, start, goal, inputs, feedback = closed_loop("copper_net")
    np.testing.assert_allclose(-feedback, [[1.834, 0.229, 0.088, -0.310, 1.028, 0.884]], atol=5e-4)
    np.testing.assert_allclose(inputs, [1.0], rtol=1e-12)
    path = sampled(closed, start - goal, 150.0, 0.01)
    collection = inputs + path @ feedback.T
    assert collection.min() == pytest.approx(-13.4, abs=0.05)
    assert collection.max() == pytest.approx(243.5, abs=0.05)
    states, effort = np.eye(6), feedback.T @ feedback
    open_loop = started("copper_net")[0].system.A
    cases = ((closed, states), (closed, states + effort), (open_loop, states))
    costs = [cost_until(150.0, loop, weight, start - goal) for loop, weight in cases]
    assert costs == pytest.approx([4.6132e6, 4.6311e6, 4.7436e6], rel=2e-5)


def cost_until(time: float, closed: Floats, weight: Floats, distance: Floats) -> float:
    """Return ∫ xᵀ weight x dt from 0 to ``time`` exactly: with AᵀP + PA = −weight it is x(0)ᵀPx(0) − x(T)ᵀPx(T)."""
    cost = solve_continuous_lyapunov(closed.T, -weight)
    last = expm(closed * time) @ distance
    return float(distance @ cost @ distance - last @ cost @ last)


@pytest.mark.parametrize("name", ["carbo_net", "copper_net"])
def test_system_is_what_the_simulator_does(name: str) -> None:
    """A, B and c predict the Euler step of the paper scenario from random stocks and controls."""
    env = MultiAgentVectorEnv(name, num_envs=20, scenario="paper")
    system = LinearSystem.of(env.network)
    rng = np.random.default_rng(3)
    initial: dict[str, Any] = {node: rng.uniform(100.0, 1000.0, 20) for node in system.states}
    env.reset(0, options={"initial_state": initial})
    rows = [env.network.node_index[node] for node in system.states]
    before, actions = env.physical.stock[rows], rng.uniform(-1.0, 1.0, (1, 20))
    low, high = system.bounds[:, :, None]
    slope = system.A @ before + system.B @ (low + (actions + 1.0) / 2.0 * (high - low)) + system.c[:, None]
    env.advance(actions)
    after = before + env.network.episode.control_interval * slope
    np.testing.assert_allclose(env.physical.stock[rows], after, rtol=1e-12)


def test_reservoir_that_drives_flows_enters_as_a_constant() -> None:
    """With collection alone acting by default, the mine's 46.8 kt/d are c; what is mined is lost, whatever returns."""
    system = LinearSystem.of(load_network("copper_net"), ["use_to_collection"])
    np.testing.assert_allclose(system.c, [46.8, 0.0, 0.0, 0.0, 0.0, 0.0], rtol=1e-12)
    assert "mine" not in system.states
    stocks, inputs = system.equilibrium()
    np.testing.assert_allclose(system.A @ stocks + system.B @ inputs + system.c, 0.0, atol=1e-10)
    use = system.states.index("use")
    assert stocks[use] == pytest.approx(46.8 / 0.25, rel=1e-9)


def test_equilibrium_is_the_nearest_to_the_set_points() -> None:
    """No equilibrium with another collection is nearer, in units of the scales."""
    system = LinearSystem.of(load_network("copper_net"), ["use_to_collection"])
    count = len(system.states)

    def distance(inputs: Floats) -> float:
        stocks = np.linalg.solve(system.A, -system.B @ inputs - system.c)
        return float((((stocks - system.set_points) / system.scale[:count]) ** 2).sum())

    _, best = system.equilibrium()
    assert distance(best) < min(distance(best + 0.1), distance(best - 0.1))


def held_loop(interval: float, steps: int) -> tuple[Floats, LQR]:
    """Return the simulated states of carbo_net, exactly solved, after each interval of full-state feedback."""
    options = {"control_interval": interval, "solver": "exact", "solver_step": None, "horizon": steps + 1}
    network = load_network("carbo_net", scenario="paper").with_options(episode=options)
    env = MultiAgentVectorEnv(network, num_envs=1)
    observations = env.reset(0)
    controller = LQR()
    controller.start(env, 0)
    rows, path = [network.node_index[node] for node in controller.system.states], []
    for _ in range(steps):
        path.append(env.physical.stock[rows, 0])
        observations = env.step(controller.act(observations))[0]
    return np.array([*path, env.physical.stock[rows, 0]]), controller


def test_zero_order_hold() -> None:
    """The simulator follows the exact sampled-data loop, x(t + h) = Φx + Γu, and hits the physical bounds nowhere."""
    found, controller = held_loop(0.25, 60)
    system = controller.system
    stocks, _ = system.equilibrium()
    held = np.zeros((5, 5))
    held[:4, :4], held[:4, 4:] = system.A, system.B
    exact = expm(held * 0.25)
    step = exact[:4, :4] - exact[:4, 4:] @ controller.gain
    expected = [found[0] - stocks]
    for _ in range(60):
        expected.append(step @ expected[-1])
    np.testing.assert_allclose(found, stocks + np.array(expected), rtol=1e-9, atol=1e-6)


def test_gains_are_those_of_continuous_time() -> None:
    """Towards short control intervals the simulated loop converges to exp((A − BK)t), at first order."""
    closed, start, goal, _, _ = closed_loop("carbo_net")
    exact = goal + expm(closed * 5.0) @ (start - goal)
    errors = [np.abs(held_loop(5.0 / steps, steps)[0][-1] - exact).max() for steps in (200, 400)]
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.05)


def test_demand_is_clipped_to_the_bounds() -> None:
    """In the default scenario of carbo_net a demand below 0 captures nothing, one above 800 t/d just that."""
    env = MultiAgentVectorEnv("carbo_net", num_envs=2, agents=["urban_to_capture"])
    initial: dict[str, Any] = {"urban_air": np.array([100.0, 3000.0]), "vehicles": 100.0, "heaters": 100.0}
    observations = env.reset(0, options={"initial_state": {**initial, "adjacent_air": 500.0}})
    controller = LQR(set_points={"urban_air": 100.0})
    controller.start(env, 0)
    low, high = controller.demand()[0]
    assert low < 0.0 and high > 800.0
    np.testing.assert_array_equal(controller.act(observations)["urban_to_capture"], [[-1.0], [1.0]])


def test_agents_that_it_does_not_drive_are_neutral() -> None:
    """With agents=... it acts where others have rate controls, as it would alone."""
    controller, env = started("copper_net", None, agents=["use_to_collection"])
    alone = LQR()
    env_alone = MultiAgentVectorEnv("copper_net", num_envs=1, agents=["use_to_collection"])
    env_alone.reset(0)
    alone.start(env_alone, 0)
    actions = controller.act({})
    np.testing.assert_array_equal(actions["use_to_collection"], alone.act({})["use_to_collection"])
    flow = env.advance(env.stack(actions)).flow
    np.testing.assert_array_equal(flow, env_alone.advance(env_alone.stack(alone.act({}))).flow)
    collected = flow[env.network.arc_index["use_to_collection"]]
    assert 40.0 < collected[0] < 80.0  # neither neutral nor at a bound


def chain(**changes: Any) -> Network:
    """Return source → a → b → sink with a controlled a → b and proportional others."""
    control = Control(kind=ControlKind.FLOW, low=0.0, neutral=1.0, high=10.0)
    arcs = {
        "in": Arc(id="in", donor="source", recipient="a", law=Law.EXOGENOUS, flow=2.0),
        "move": Arc(id="move", donor="a", recipient="b", law=Law.CONTROLLED, control=control),
        "out": Arc(id="out", donor="b", recipient="sink", law=Law.DONOR, rate=0.5),
    }
    nodes = [Node(id="source", initial=(1e3, 1e3)), Node(id="a", initial=(20.0, 20.0), set_point=10.0)]
    return Network(
        name="chain",
        nodes=(*nodes, Node(id="b", initial=(8.0, 8.0)), Node(id="sink")),
        arcs=tuple({**arcs, **changes}.values()),
        episode=Episode(control_interval=0.1, horizon=401),
    )


def test_store_without_outflow_of_its_own() -> None:
    """A stock that only control empties is an integrator in reach: it is brought to its set-point."""
    controller = LQR()
    run = rollout(MultiAgentVectorEnv(chain(), num_envs=2), controller)
    assert controller.system.states == ("a", "b")
    np.testing.assert_allclose(np.concatenate(controller.system.equilibrium()), [10.0, 4.0, 2.0], rtol=1e-12)
    np.testing.assert_allclose(run.stock[-1, 1:3], [10.0, 4.0], rtol=1e-3)
    np.testing.assert_allclose(run.flow[-1, 1], 2.0, rtol=1e-3)


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        (lambda: started("copper_net", None), r"'copper_net' \(default\) .* rate controls .*bilinear.* refinery, fab"),
        (
            lambda: started("copper_net", None),
            r"Let only agents act that set flows: in Python agents=\['use_to_collection'\], on the command line "
            r"--scenario paper$",
        ),
        (
            lambda: LinearSystem.of(load_network("copper_net").with_options(episode={"horizon": 3})),
            r"agents=\['use_to_collection'\], on the command line --scenario NAME, one where only these act$",
        ),
        (lambda: started("solids_net", None), r"'solids_net' .* batches move along 'first_use'"),
        (lambda: started("net_zero", None), r"inner physics drives 'emission'.*\. No choice of agents makes it one$"),
        (lambda: started("carbo_net", None, agents=["urban_to_capture"]), r"out of bounds, 'urban_air' = -782\.8"),
        (
            lambda: started("carbo_net", None, agents=["urban_to_capture"], set_points={"capture": 1e4}),
            "no control reaches the mode with eigenvalue 0",
        ),
        (lambda: started(set_points={}), "leave 'adjacent_air' free"),
        (lambda: started(set_points={"urban_ai": 1.0}), "unknown node 'urban_ai'. Did you mean 'urban_air'"),
        (lambda: started(set_points={"urban_air": np.nan}), "must be finite"),
        (lambda: started(outputs=["vehicles"]), "weights ignore the mode with eigenvalue 0"),
        (lambda: started("copper_net", outputs=["use"]), r"output feedback does not stabilise .* 0\.0438796"),
        (lambda: started(outputs=["urban_ai"]), "unknown output 'urban_ai'. Did you mean 'urban_air'"),
        (lambda: started(outputs=[]), "unknown output ''"),
        (lambda: started(agents=["vehicles"]), "unknown agent 'vehicles'"),
        (lambda: started(state_weight=[0.0, 1.0, 1.0, 0.0]), "weights ignore the mode with eigenvalue 0"),
        (lambda: started(state_weight=[1.0, 1.0]), "state_weight must be .* of 4 rows"),
        (lambda: started(state_weight=[1.0, 1.0, 1.0, -1.0]), "positive semi-definite"),
        (lambda: started(state_weight=np.triu(np.ones((4, 4)))), "symmetric"),
        (lambda: started(input_weight=[0.0]), "input_weight must be .* positive definite"),
        (
            lambda: LinearSystem.of(
                chain(**{"in": replace(chain().arcs[0], flow=Series(times=(0.0, 3.0), values=(1.0, 2.0)))})
            ),
            "numbers change in time: in",
        ),
        (
            lambda: LinearSystem.of(
                chain(out=replace(chain().arcs[2], law=Law.EXOGENOUS, rate=0.0, flow=3.0)),
                set_points={"a": 10.0, "b": 4.0},
            ).equilibrium(),
            "no equilibrium",
        ),
    ],
)
def test_refusals(attempt: Callable[[], object], message: str) -> None:
    """What is not linear, not regulable or not understood is refused with the reason."""
    with pytest.raises(CirlError, match=message):
        attempt()


def test_output_feedback_that_does_not_converge(monkeypatch: pytest.MonkeyPatch) -> None:
    """Too few iterations are an error, not a gain."""
    monkeypatch.setattr("cirl_marl.controllers.lqr.ITERATIONS", 2)
    with pytest.raises(CirlError, match="not converged in 2 iterations"):
        started(outputs=MEASURED)
