"""What copies plan for, written down at once, is what each of them would plan for alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from cirl_marl import MultiAgentVectorEnv, load_network
from cirl_marl.network.uncertainty import draw_network, network_of_intervals
from cirl_marl.optimum import mpc
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.futures import GRID, DrawnFutures
from cirl_marl.optimum.matrices import IntervalCache
from cirl_marl.optimum.program import Programs
from cirl_marl.optimum.window_planner import Future
from cirl_marl.optimum.windows import WindowTask

COURSES: list[np.ndarray] = []
"""Paths from which futures were made."""
WORLDS = (("paper_city", "breakdowns"), ("steel_japan", "japan_shocks"), ("car_batteries", "adoption"))


def under_way(network: str, scenario: str, steps: int, copies: int) -> MultiAgentVectorEnv:
    """Return copies of a world after some intervals of random actions."""
    env = MultiAgentVectorEnv(network, num_envs=copies, scenario=scenario)
    env.reset(seed=5)
    random = np.random.default_rng(1)
    for _ in range(steps):
        env.advance(random.uniform(-1.0, 1.0, (len(env.actuators.control_rows), copies)))
    return env


def drawn_futures(env: MultiAgentVectorEnv, count: int | None) -> DrawnFutures:
    """Return those of an environment."""
    controller = mpc.MPC(min_service=0.99, horizon=3, futures=count)
    controller.plan(env, 0, lambda share: None)
    assert controller._drawn is not None
    return controller._drawn


def assert_alike(future: Future, programs: Programs, stock: np.ndarray, intervals: range) -> None:
    """The program of a future is that of its network alone."""
    task = WindowTask(stock, intervals, None, None, np.zeros(0), None)
    own, alone = future.program(task, None), programs.program(stock, None, intervals)
    assert own.layout.size == alone.layout.size
    for name in ("equal", "under"):
        difference = abs(getattr(own, name) - getattr(alone, name)).max()
        assert difference <= 1e-9 * abs(getattr(alone, name)).max()
    for name in ("equal_to", "under_to", "low", "high"):
        values = getattr(alone, name)
        np.testing.assert_allclose(getattr(own, name), values, rtol=1e-5, atol=1e-9 * np.abs(values).max())


@pytest.mark.parametrize(("network", "scenario"), WORLDS)
@pytest.mark.parametrize("count", [None, 2])
@pytest.mark.slow
def test_programs_are_those_of_each_copy_alone(network: str, scenario: str, count: int | None) -> None:
    """Rows, right-hand sides and boxes, with whatever is kept from other copies and decisions."""
    env = under_way(network, scenario, 3, 2)
    drawn, intervals, world = drawn_futures(env, count), range(3, 6), env.network
    if env.dynamics.substeps > 1:
        world = world.with_options(episode={"solver_step": env.dynamics.substep})
    values = env.physical.disturbances[3]
    for copy, futures in zip((0, 1), drawn.of((0, 1), intervals), strict=True):
        assert len(futures) == (count or 1)
        stock = env.physical.stock[env.rows.nodes, copy]
        for future in futures:
            path = env.network.processes.prior_means(env.network.episode.horizon)
            place = future.places(intervals).start
            path[3:6] = COURSES[-1][place : place + 3]
            np.testing.assert_allclose(path[3], values[:, copy], rtol=1e-12)  # what is, is as it is
            admissible = Admissible.of(draw_network(world, (), path), env.agents)
            alone = Programs(admissible, 1, None, layout=future.layout, cache=IntervalCache())
            assert_alike(future, alone, stock, intervals)


@pytest.fixture(autouse=True)
def recorded_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the paths from which futures are made."""

    def recorded(network: object, factors: Sequence[float], path: np.ndarray) -> object:
        COURSES.append(path)
        return draw_network(network, factors, path)

    monkeypatch.setattr("cirl_marl.optimum.futures.draw_network", recorded)


def test_what_is_to_come_is_rounded_from_what_is_expected() -> None:
    """By at most half a part of the range, within it, and nothing that only bands of services depend on."""
    env = under_way("paper_city", "breakdowns", 2, 3)
    drawn, processes = drawn_futures(env, None), env.network.processes
    drawn.of((0, 1, 2), range(2, 6))
    courses = COURSES[-1].reshape(3, 4, -1)
    means = processes.conditional_means(env.physical.processes[2], 2, 3)
    prior = processes.prior_means(6)[3:]
    for n, name in enumerate(processes.names):
        exact, course = means[:, n].T, courses[:, 1:, n]
        part = (processes.high[n] - processes.low[n]) / GRID
        if name in ("orders", "line_runs"):
            np.testing.assert_allclose(course, exact, rtol=1e-12)
            continue
        assert (np.abs(course - exact) <= part / 2 * (1 + 1e-9)).all() and (course != exact).any()
        parts = (course - prior[:, n]) / part
        is_end = (course == processes.low[n]) | (course == processes.high[n])
        np.testing.assert_allclose(np.where(is_end, 0.0, parts), np.where(is_end, 0.0, np.rint(parts)), atol=1e-9)


def test_a_network_of_other_intervals() -> None:
    """Rates, bands and lifetimes are those of the intervals that were asked for, in any order."""
    network = draw_network(load_network("steel_japan"))
    intervals = np.array([7, 7, 2, 25, 0])
    original, moved = (Admissible.of(each) for each in (network, network_of_intervals(network, intervals)))
    for name in ("rate", "setting", "valve"):
        np.testing.assert_allclose(getattr(moved, name), getattr(original, name)[:, intervals], rtol=1e-12)
    np.testing.assert_allclose(moved.service_low, original.service_low[intervals], rtol=1e-12)
    for own, other in zip(moved.lifetimes.whole, original.lifetimes.whole, strict=True):
        np.testing.assert_allclose(own.rate, other.rate[intervals], rtol=1e-12)
    assert moved.lifetimes.network.nodes[0].history == network.nodes[0].history
    assert len(np.unique(original.service_low)) > 1
