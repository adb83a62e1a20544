"""Exact gradients against central differences of the simulator, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from small_networks import KINDS, booked, cycle, disturbed_networks, small
from test_capacities import power

import cirl_marl
from cirl_marl import Arc, CirlError, ControlError, Law, MultiAgentVectorEnv, Network, load_network
from cirl_marl.dynamics import supply
from cirl_marl.environments.state import State
from cirl_marl.network.disturbances import DisturbanceEffect

BATCH = Arc(id="van", donor="a", recipient="b", law=Law.BATCH, batches=((0.0, 1.0),), delay=1.0)
PULL = Arc(id="pull", donor="a", recipient="b", law=Law.RECIPIENT, rate=0.9)
STEP = 1e-4
"""Of differences, relative to what is changed."""


def differentiable(network: Network) -> Network:
    """Return the network with the exact solver, and with a steady flow where mass moved in batches."""
    arcs = [
        replace(arc, law=Law.EXOGENOUS, batches=(), delay=0.0, flow=20.0) if arc.law is Law.BATCH else arc
        for arc in network.arcs
    ]
    return replace(network, arcs=tuple(arcs)).with_options(episode={"solver": "exact", "solver_step": None})


def slope(value: Callable[[float], np.ndarray], step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the fourth-order difference of a function of a shift, and whether it is smooth within the steps."""
    ends = {k: value(k * step) for k in (-2, -1, 0, 1, 2)}
    near, far = (ends[1] - ends[-1]) / (2 * step), (ends[2] - ends[-2]) / (4 * step)
    forward, backward = (ends[1] - ends[0]) / step, (ends[0] - ends[-1]) / step
    size = np.abs(near) + np.abs(far) + 1e-12
    smooth = (np.abs(near - far) < 1e-4 * size) & (np.abs(forward - backward) < 1e-2 * size)
    return (4 * near - far) / 3, smooth | (size < 1e-9)


def check(env: MultiAgentVectorEnv, seed: int, monkeypatch: pytest.MonkeyPatch) -> int:
    """Compare every kind of derivative with differences; return how many are smooth."""
    monkeypatch.setattr(supply, "CLOSE", 1e-14)
    rng, horizon, batch = np.random.default_rng(seed), env.network.episode.horizon, env.num_envs
    env.reset(seed)
    entries, services = len(env.actuators.control_rows), len(env.network.services)
    actions = rng.uniform(-0.9, 0.9, (horizon, entries, batch))
    circularity, levels = rng.normal(), rng.normal(size=services) * 30
    accounts = rng.normal(size=len(env.network.accounts)) / horizon
    state, controls = env.physical, env.controls
    exact_gradient = cirl_marl.gradient(env, actions, circularity=circularity, levels=levels, accounts=accounts)
    assert env.physical is state

    def value(start: State, schedule: np.ndarray) -> np.ndarray:
        env.go_back(start, controls)
        for action in schedule:
            env.advance(action)
        total, mean = env.physical, horizon
        value: np.ndarray = circularity * total.circularity / mean + levels @ (total.service / mean)
        return value + accounts @ total.accounts

    np.testing.assert_allclose(
        circularity * exact_gradient.circularity + levels @ exact_gradient.levels + accounts @ exact_gradient.accounts,
        value(state, actions),
        rtol=1e-12,
        atol=1e-12,
    )

    def along(part: str, direction: np.ndarray) -> Callable[[float], np.ndarray]:
        def shifted(shift: float) -> np.ndarray:
            if part == "actions":
                return value(state, actions + shift * direction)
            rows = {"start": "stock", "disturbances": "disturbances", "draws": "factors"}[part]
            changed = getattr(state, rows).copy()
            changed[: len(direction)] += shift * direction
            return value(replace(state, **{rows: changed}), actions)

        return shifted

    round_off = 4 * np.finfo(float).eps * np.abs(value(state, actions)) / STEP  # of differences
    smooth_count = 0
    for part in ("actions", "start", "disturbances", "draws"):
        exact = getattr(exact_gradient, part)
        size = {"actions": np.ones_like(actions), "start": state.stock[: len(exact_gradient.start)]}.get(
            part, np.full_like(exact, 0.1)
        )
        largest = np.abs(exact * size).max(initial=0.0)
        places = [tuple(place) for place in np.argwhere(np.ones(exact.shape[:-1]))]
        for k in rng.permutation(len(places))[:6]:
            direction = np.zeros_like(exact)
            direction[places[k]] = size[places[k]]
            difference, smooth = slope(along(part, direction), STEP)
            error = np.abs(difference - (exact * direction).reshape(-1, batch).sum(axis=0))
            is_close = error <= 1e-6 * largest + 1e-9 + round_off
            assert is_close[smooth].all(), (part, places[k], difference, exact[places[k]])
            smooth_count += int(smooth.sum())
    env.go_back(state, controls)
    return smooth_count


@given(network=st.from_type(Network) | disturbed_networks(), seed=st.integers(0, 1000))
def test_random_networks(network: Network, seed: int) -> None:
    """With lifetimes, shares, loops, series, scheduled flows, bands and disturbances, in many substeps and copies."""
    network = differentiable(booked(network, seed) if seed % 2 else network)
    assume(network.agents)
    with pytest.MonkeyPatch.context() as monkeypatch:
        env = MultiAgentVectorEnv(network, num_envs=2, uncertain=bool(network.uncertain))
        try:
            check(env, seed, monkeypatch)
        except CirlError as error:
            assert "ran out" in str(error)
            assume(False)


@pytest.mark.medium
@pytest.mark.sample(2)
@pytest.mark.parametrize(
    "name", ["copper_net", "carbo_net", "paper_city", "copper_world", "car_batteries", "steel_japan"]
)
def test_networks_of_the_catalogue(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over a few intervals; in some of them supplies make up for services."""
    assert check(MultiAgentVectorEnv(name, num_envs=2, horizon=2), 1, monkeypatch) > 12


@pytest.mark.parametrize(
    ("base", "path"),
    [
        ("cycle", "arcs.slag.share"),
        ("cycle", "arcs.use_loss.share"),
        ("cycle", "arcs.mining.control.high"),
        ("cycle", "services.housed.low"),
        ("copper_world", "services.in_use.low"),
        ("copper_world", "arcs.mining.control.high"),
        ("power", "arcs.run_old.capacity_rate"),
    ],
)
@pytest.mark.medium
@pytest.mark.sample(3)
def test_what_disturbs(base: str, path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shares, capacities, limits and demand, of supplies that make up for services too."""
    bases = {"cycle": cycle(), "power": power()}
    network = (bases.get(base) or load_network(base)).with_options(episode={"horizon": 2})
    disturbed = {path: DisturbanceEffect(by="price")}
    network = replace(network, disturbances={"price": KINDS["price"]}, disturbed=disturbed, scenarios={})
    env = MultiAgentVectorEnv(network, num_envs=2)
    assert check(env, 1, monkeypatch) > 8
    actions = np.zeros((2, len(env.actuators.control_rows)))
    by_values = cirl_marl.gradient(env, actions, levels=1.0).disturbances[:2]
    assert np.abs(by_values).max() > 0 or path == "arcs.mining.control.high"  # unless there is enough of it


def test_copies_are_alone() -> None:
    """The derivatives of a copy are those that it has alone."""
    network = cycle()
    env, rng = MultiAgentVectorEnv(network, num_envs=3), np.random.default_rng(0)
    env.reset(5)
    actions = rng.uniform(-1, 1, (4, len(env.actuators.control_rows), 3))
    together = cirl_marl.gradient(env, actions, levels=[1.0, 2.0])
    lone = MultiAgentVectorEnv(network, num_envs=1)
    lone.reset(6)
    alone = cirl_marl.gradient(lone, actions[..., 1:2], levels=[1.0, 2.0])
    np.testing.assert_allclose(together.actions[..., 1:2], alone.actions, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(together.start[:, 1:2], alone.start, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("network", "reason"),
    [
        ("solids_net", r"'solids_net' cannot be differentiated: compartment 'sorter' has a model, SortingStation"),
        (small({"a": 5.0, "b": 0.0}, [BATCH]), r"arc 'van' moves mass in batches"),
        (cycle().with_options(episode={"solver": "rk4", "solver_step": 1 / 64}), r"solver 'rk4' moves it"),
        (small({"a": 1.0, "b": 9.0}, [PULL]), r"stock of node 'a' in copy 0 ran out"),
    ],
)
def test_what_has_no_derivative(network: str | Network, reason: str) -> None:
    """Is refused, with the compartment and the reason."""
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(0)
    with pytest.raises(CirlError, match=reason):
        cirl_marl.gradient(env, np.zeros((2, len(env.actuators.control_rows))))


def test_schedules_are_checked() -> None:
    """Their shape, and how long they are."""
    env = MultiAgentVectorEnv("copper_net", num_envs=2, horizon=3)
    env.reset(0)
    for shape in ((3, 15), (4, 16), (2, 16, 3), (0, 16)):
        with pytest.raises(ControlError, match=r"actions have shape .* expected \(intervals, 16\)"):
            cirl_marl.gradient(env, np.zeros(shape))


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"levels": [1, 2, 3]}, r"levels have shape \(3,\), expected a number, or \(1,\) or \(1, 2\)"),
        ({"levels": np.ones((2, 1))}, r"levels have shape \(2, 1\)"),
        ({"levels": np.nan}, "levels nan are not finite"),
        ({"levels": "a"}, "levels 'a' are no numbers"),
        ({"circularity": [1, 2, 3]}, r"circularity have shape \(3,\), expected a number, or \(2,\)$"),
        ({"accounts": [1.0]}, r"accounts have shape \(1,\), expected a number, or \(0,\) or \(0, 2\)"),
    ],
)
def test_weights_are_checked(weights: dict[str, Any], message: str) -> None:
    """Name, what was given and what is expected; the environment stays where it is."""
    env = MultiAgentVectorEnv("copper_net", num_envs=2, horizon=3)
    env.reset(0)
    with pytest.raises(ControlError, match=message):
        cirl_marl.gradient(env, np.zeros((3, 16)), **weights)
    assert (env.physical.step == 0).all()
