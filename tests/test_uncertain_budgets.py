"""Budgets of expected amounts on accounts in the bound for who does not foresee: all paths at once, and policies."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_uncertain_bound import CHAIN, Paths, merits, prices_of, works

from cirl_marl import Account, CirlError, MultiAgentVectorEnv, Network, bound, compare
from cirl_marl.controllers import Constant, Controller, Neutral, Random
from cirl_marl.controllers.rollout import first_seed, rollout
from cirl_marl.network.disturbances import DisturbanceEffect
from cirl_marl.network.uncertainty import expected_network
from cirl_marl.optimum.aims import aims_of
from cirl_marl.optimum.draw_proofs import Sampling
from cirl_marl.optimum.mpc import MPC
from cirl_marl.optimum.price_fit import fit_prices

Floats = NDArray[np.float64]
DEMAND, BOTH = 0.6, {"emissions": 3.0, "cost/year": 4.2}


def emitting(horizon: int) -> Network:
    """Return the works, in which years are intervals: what is dug and melted emits, more so in an outage."""
    network = works(horizon)
    rates = {"dig": {"emissions": 1.0}, "melt": {"emissions": 1.5, "cost": 2.0}, "make": {"cost": 1.0}}
    arcs = tuple(replace(arc, accounts=rates.get(arc.id, {})) for arc in network.arcs)
    nodes = tuple(replace(node, holding={"cost": 0.5} if node.id == "plant" else {}) for node in network.nodes)
    accounts = (Account(id="emissions", unit="t CO2e", discount=0.1), Account(id="cost", unit="EUR_2023", discount=0.5))
    disturbed = {**network.disturbed, "arcs.melt.accounts.emissions": DisturbanceEffect(by="outage")}
    return replace(network, arcs=arcs, nodes=nodes, accounts=accounts, disturbed=disturbed, time_unit="year")


@pytest.mark.parametrize(
    "at_most",
    [
        pytest.param({"emissions": 2.5}, marks=pytest.mark.slow),
        pytest.param({"cost/year": 4.0}, marks=pytest.mark.slow),
        {"emissions": 2.5, "cost/year": 4.5},
    ],
)
@pytest.mark.slow
def test_with_budgets_too_the_bound_is_that_of_all_paths_at_once(at_most: dict[str, float]) -> None:
    """With the multipliers of the extensive form it is its optimum; with others never less, with fitted ones near."""
    network = emitting(3)
    aims = aims_of(network, "circularity", at_most)
    paths = Paths.of(network, aims=aims)
    free, (best, weights, multipliers) = Paths.of(network).best(DEMAND)[0], paths.best(DEMAND, states_only=True)
    assert best < free - 0.03 and (multipliers[1:] > 1e-3).any()
    demand = np.append(DEMAND, -aims.limits / aims.sizes)
    charged = replace(prices_of(network, 0, 0.0, DEMAND, 0.0), service=multipliers, demand=demand)
    proofs = [
        program.prove(program.with_weights(weight, 0.0, charged)).value
        for program, weight in zip(paths.programs, weights, strict=True)
    ]
    assert paths.chance @ np.array(proofs) == pytest.approx(best, abs=1e-6)
    for seed in range(3):
        arbitrary = prices_of(network, seed, 0.03, DEMAND, 0.0)
        assert paths.mean(replace(arbitrary, service=(0.5 + seed) * multipliers, demand=demand)) >= best - 1e-8
    drawn = np.random.default_rng(0).choice(len(paths.chance), 64, p=paths.chance)
    _, fitted = fit_prices([paths.programs[i] for i in drawn], np.array([DEMAND]), 1.0)
    assert best - 1e-8 <= paths.mean(fitted) <= best + 0.1 * (free - best)


def small_bound(at_most: dict[str, float] | None, min_service: float | None = DEMAND, **options: Any) -> Any:
    """Return the bound of the works over a few intervals."""
    sampling = Sampling(**{"draws": 16, "fit_draws": 32, **options})
    return bound(emitting(4), min_service=min_service, at_most=at_most, degree=1, uncertain=sampling)


@pytest.fixture(scope="module")
def kept() -> Any:
    """Return the bound with budgets of an episode and of years."""
    return small_bound(BOTH)


@pytest.mark.slow
def test_who_keeps_budgets_on_average_stays_below(kept: Any) -> None:
    """In every draw with the penalty, whatever is booked; a mean that keeps the budgets is below the mean bound."""
    free, network = small_bound(None), kept.network
    assert kept.value < free.value - 0.02
    assert kept.verify() == pytest.approx(kept.value, abs=1e-12)
    policies: list[Controller] = [
        Neutral(),
        Random(),
        MPC(min_service=DEMAND),
        MPC(min_service=0.7, at_most={"emissions": 3.0}),
    ]
    grid = product(np.linspace(-1, 1, 5).tolist(), (-1.0, 0.0, 1.0), (0.0, 1.0))
    policies += [Constant({"dig": dig, "melt": melt, "make": make}) for dig, melt, make in grid]
    env, keepers = MultiAgentVectorEnv(network, num_envs=16), 0
    for policy in policies:
        run = rollout(env, policy, seed=first_seed(kept.sampling.seed))
        bookings = kept.aims.bookings(run)
        sums = [run.accounts[:, 0], *run.bookings[:, 1].T]
        np.testing.assert_allclose(bookings.T, sums)
        gaps = kept.gaps(run.episode_circularity, run.episode_levels, bookings)
        levels = np.concatenate([run.episode_levels, -bookings / kept.aims.sizes], axis=1)
        merit = run.episode_circularity + kept.prices.service_value(levels)
        np.testing.assert_allclose(gaps, (kept.values - merit) / kept.scale)
        _, penalty = merits(network, replace(kept, prices=_of_services(kept.prices)), policy)
        if not isinstance(policy, Random):  # which acts otherwise when it is asked again
            assert (merit - penalty <= kept.values + 1e-7).all()
        if (bookings.mean(axis=0) <= kept.aims.limits).all() and run.episode_levels.mean() >= DEMAND:
            keepers += 1
            assert run.episode_circularity.mean() <= kept.upper
    assert keepers > 1


def _of_services(prices: Any) -> Any:
    """Return prices without those of budgets."""
    return replace(prices, service=prices.service[:1], demand=prices.demand[:1])


@pytest.mark.slow
def test_the_record_says_which_budgets(kept: Any) -> None:
    """In its text, prices and figures; gaps need what is booked."""
    assert "expected emissions at most 3 t CO2e, expected cost at most 4.2 EUR_2023 a year" in str(kept)
    names = ["emissions", *(f"cost in year {year}" for year in range(1, 5))]
    assert [*kept.budget_prices] == names and max(kept.budget_prices.values()) > 0
    assert [*kept.budget_prices.values()] == pytest.approx(kept.prices.service[1:] / [3.0, *[4.2] * 4])
    figures = kept.as_dict()
    assert figures["budget_prices"] == kept.budget_prices and [*figures["service_prices"]] == ["served"]
    with pytest.raises(CirlError, match=r"bookings of shape \(16, 0\); expected \(16, 5\), what is booked"):
        kept.gaps(np.zeros(16), np.ones((16, 1)))
    comparison = compare((), ("neutral",), network=kept.network, bounds=False, uncertain_bound=kept)
    (entry,) = comparison.rows[0].entries
    bookings = kept.aims.bookings(entry.rollout)
    expected = kept.gaps(entry.circularity, entry.rollout.episode_levels, bookings)
    np.testing.assert_array_equal(entry.expected_gap, expected)
    foresight = kept.gaps(entry.circularity, entry.rollout.episode_levels, bookings, with_foresight=True)
    np.testing.assert_array_equal(entry.foresight_gap, foresight)
    assert (foresight != expected).any()


@pytest.mark.slow
def test_budgets_of_expected_amounts_that_cannot_be_meant_are_refused(kept: Any) -> None:
    """Out of reach, of no account, and prices of budgets for plans that cannot keep any."""
    text = r"no policy keeps an expected cost in year 1 at most 0\.1 EUR_2023 \(at .* tried 16 draws come to (\S+)\)"
    with pytest.raises(CirlError, match=text) as raised:
        small_bound({"cost/year": 0.1}, None)
    least = -bound(expected_network(emitting(1)), aim="cost", degree=1).objective
    assert least < float(re.findall(text, str(raised.value))[0]) < 2 * least
    with pytest.raises(CirlError, match=r"no policy reaches .* draws, expected emissions at most 0\.1 t CO2e\)"):
        small_bound({"emissions": 0.1})
    with pytest.raises(CirlError, match=r"unknown account 'emission'\. Did you mean 'emissions'"):
        small_bound({"emission": 0.1})
    with pytest.raises(CirlError, match="those of a bound with budgets, which no plan of one interval can keep"):
        MPC(min_service=DEMAND, prices=kept.prices).start(MultiAgentVectorEnv(kept.network, num_envs=1), 0)


@pytest.mark.slow
def test_proofs_of_other_budgets_are_other_jobs(tmp_path: Any) -> None:
    """Those on disk are of one question; a budget that binds nobody changes nothing."""
    loose, free = (small_bound(budget, directory=tmp_path) for budget in ({"emissions": 1e3}, None))
    elsewhere = small_bound({"cost": 1e3}, directory=tmp_path)
    np.testing.assert_array_equal(elsewhere.prices.service, loose.prices.service)
    assert len({path.name.split("-")[1] for path in tmp_path.glob("draws-*.npz")}) == 3
    np.testing.assert_allclose(loose.values, free.values, atol=1e-6)
    assert CHAIN in loose.network.disturbances.values() and loose.prices.service[1] == 0.0
