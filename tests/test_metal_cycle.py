"""An ordinary material flow analysis of 30 years, from its file to its flows: the example ``metal_cycle``."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from cirl_marl import MultiAgentVectorEnv, load_network
from cirl_marl.controllers import Constant
from cirl_marl.controllers.lint import lint_warnings
from cirl_marl.controllers.rollout import episode_start

EXAMPLE = Path(__file__).parent.parent / "examples" / "metal_cycle.toml"


def by_hand(collected: np.ndarray, mining: bool) -> dict[str, np.ndarray]:
    """Return flows and stocks of all years in closed form, from the columns of the data file; ore only if mining."""
    with EXAMPLE.with_suffix(".csv").open() as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    known = [row["year"] for row in rows]
    years = np.arange(2020, 2050)
    # the mean of straight lines over a year in which none of them bends is their value in the middle
    demand, products = (
        np.interp(years + 0.5, known, [row[key] for row in rows]) for key in ("demand", "fabrication_yield")
    )
    demand = demand * mining
    stock, found = 1100.0, []
    for ore, kept, share in zip(demand, products, collected, strict=True):
        # ingots = ore + scrap, of which 99 % is made into products or comes back: the loop multiplies both sources
        loop = 0.99 / (1.0 - 0.99 * (1.0 - kept))
        gain, rate = kept * loop, 0.04
        # dx/dt = gain·(ore + share·rate·x) − rate·x
        net = rate * (1.0 - gain * share)
        after = stock * np.exp(-net) + gain * ore * -np.expm1(-net) / net
        released = rate * (gain * ore - (after - stock)) / net
        found.append((after, released, loop * (ore + share * released)))
        stock = float(after)
    use, released, fabricated = np.array(found).T
    return {"use": use, "end_of_life": released, "casting": fabricated, "smelting": demand}


@pytest.mark.parametrize(("action", "mining"), [(None, True), (-1.0, True), (1.0, True), (1.0, False)])
def test_flows_of_thirty_years_against_closed_forms(action: float | None, mining: bool) -> None:
    """Stocks and flows of every year; the loop of new scrap and yields that rise from year to year included.

    Without ore the stock falls short of a demand that grows, by a share that is another in each year.
    """
    env = MultiAgentVectorEnv(load_network(EXAMPLE), num_envs=1)
    begun = episode_start(env)
    held = {} if action is None else {"old_scrap": action}
    run = begun.play(env, Constant(held if mining else held | {"smelting": -1.0}))
    highest = np.where(np.arange(2020, 2050) < 2040, 0.5, 0.9)
    collected = {None: np.full(30, 0.5), -1.0: np.full(30, 0.3), 1.0: highest}[action]
    expected = by_hand(collected, mining)
    network = env.network
    np.testing.assert_allclose(run.stock[:, network.node_index["use"]], expected["use"], rtol=1e-11)
    for arc in ("end_of_life", "casting", "smelting"):
        np.testing.assert_allclose(run.flow[:, network.arc_index[arc]], expected[arc], rtol=1e-11)
    lost = run.flow[:, [network.arc_index[arc] for arc in ("smelting", "lost", "dross")]].sum(axis=1)
    np.testing.assert_allclose(run.circularity_mean[0], -lost, rtol=1e-12)
    demanded = 1000 + 800 * (np.arange(30) + 0.5) / 30
    np.testing.assert_allclose(run.service[0], np.minimum(1.0, expected["use"] / demanded), rtol=1e-11)
    assert (run.service[0].min() == 1.0) == mining


@pytest.mark.parametrize("circularity", ["end", "mean"])
def test_the_difference_is_to_what_is_neutral_that_year(circularity: str) -> None:
    """λ − λ of a second network, put into the same state, in which that agent did what is neutral in this year."""
    envs = [
        MultiAgentVectorEnv(load_network(EXAMPLE), num_envs=2, reward=reward, circularity=circularity)
        for reward in ("difference", "circularity")
    ]
    env, imagined = envs
    assert env.agents == ("smelting", "old_scrap")
    for each in envs:
        each.reset(1)
    rng = np.random.default_rng(0)
    years = np.arange(2020, 2050) + 0.5
    demand = np.interp(years, [2020, 2030, 2040, 2051], [90, 115, 135, 150])
    highest = np.where(years < 2040, 0.5, 0.9)
    neutral = np.stack([2 * demand / 160 - 1, 2 * (0.5 - 0.3) / (highest - 0.3) - 1])
    for year in range(30):
        actions, here = rng.uniform(-1, 1, (2, 2)), env.snapshot()
        reward = env.advance(actions).reward
        imagined.restore(here)
        actual = imagined.advance(actions).reward[0]
        for row in range(2):
            imagined.restore(here)
            other = actions.copy()
            other[row] = neutral[row, year]
            np.testing.assert_allclose(reward[row], actual - imagined.advance(other).reward[0], atol=1e-9)


def test_nothing_is_remarked_on() -> None:
    """Neither a source too small nor a valve taken for a share."""
    assert not list(lint_warnings(load_network(EXAMPLE)))
