"""Budgets of a disturbed episode: in expectation they hold, by multipliers that are tuned on other draws."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_networks import city

from cirl_marl import MPC, CirlError, MultiAgentVectorEnv, Network, compare
from cirl_marl.controllers.rollout import rollout
from cirl_marl.evaluation import calibration
from cirl_marl.network.disturbances import AutoRegression, DisturbanceEffect
from cirl_marl.optimum import bound, simulate_plan
from cirl_marl.optimum.aims import aims_of
from cirl_marl.optimum.registry import named_controller


def with_random_demand(deviation: float) -> Network:
    """Return the city in years, six of them, with a demand that nobody foresees."""
    network = replace(city().with_options(episode={"horizon": 6}), time_unit="year")
    demand = AutoRegression(deviation=deviation, persistence=0.8, low=0.5, high=1.6)
    effect = {f"services.{network.services[0].id}.low": DisturbanceEffect(by="demand")}
    return replace(network, disturbances={"demand": demand}, disturbed=effect)


def halfway_in_years(network: Network, level: float) -> float:
    """Return a budget halfway between the emissions of the cleanest and of the most circular plan."""
    certain = replace(network, disturbances={}, disturbed={})
    ends = [simulate_plan(bound(certain, aim=aim, min_service=level)) for aim in ("emissions", "circularity")]
    return float(np.mean([run.accounts[0, 1] for run in ends]))


@pytest.mark.parametrize(("level", "futures"), [(0.9, None), (0.8, 2)])
@pytest.mark.slow
def test_budgets_of_disturbed_episodes_hold_in_expectation(level: float, futures: int | None) -> None:
    """The mean of 24 paths comes within 4 % of the budget; single ones do not have to."""
    network = with_random_demand(0.3)
    most = halfway_in_years(network, level)
    control = MPC(min_service=level, at_most={"emissions": most}, futures=futures)
    used = rollout(MultiAgentVectorEnv(network, num_envs=24), control, seed=5).accounts[:, 1] / most
    assert 0.96 < used.mean() < 1.02 and used.std() > 0.005


def test_margins_on_budgets_rise_until_the_mean_keeps_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside services, whose levels fall as budgets get dearer; years, and budgets that are kept, ask for nothing."""
    network = with_random_demand(0.3)
    margins = []

    def played(env: MultiAgentVectorEnv, options: dict[str, float], seed: int) -> Any:
        margin, dearer = options.get("margin", 1.0), options.get("budget_margin", 1.0)
        margins.append((margin, dearer))
        noise = np.linspace(-0.3, 0.3, env.num_envs)[:, None]
        accounts = np.repeat([[900.0, 1000.0]], env.num_envs, axis=0) * (1 + noise) * margin**0.1 / dearer**0.5
        levels = 0.8 * margin**0.5 / dearer**0.2 + noise
        return SimpleNamespace(episode_levels=levels, accounts=accounts, bookings=np.repeat(accounts[:, :, None], 6, 2))

    monkeypatch.setattr(calibration, "rollout", played)
    options: dict[str, Any] = {"env": lambda copies: MultiAgentVectorEnv(network, num_envs=copies), "controller": dict}
    options |= {"demand": np.array([0.85]), "draws": 10}
    for budgets, least in (({"emissions": 950.0, "emissions/year": 1.0}, 1.05), ({"emissions": 1100.0}, 1.0)):
        result = calibration.calibrate(**options, aims=aims_of(network, "circularity", budgets))
        most = budgets["emissions"]
        margin = float(np.max(result.margin))
        level = 0.8 * margin**0.5 / result.budget_margin**0.2
        used = 1000.0 * margin**0.1 / result.budget_margin**0.5
        assert result.excess == pytest.approx(level - 0.85) and abs(result.excess) < 0.002
        assert result.overrun == pytest.approx(max(0.0, used / most - 1)) and result.overrun <= 0.001
        assert result.budget_margin >= least and (least > 1.0 or result.budget_margin == 1.0)
        assert result.margins == dict(zip(("margin", "budget_margin"), margins[-1], strict=True)) or least == 1.0
    assert calibration.calibrate(**options).margins.keys() == {"margin"}


@pytest.mark.slow
def test_tuned_mpc_keeps_services_and_budgets_on_average() -> None:
    """On draws that nobody tuned on, and it says with which margins."""
    network = with_random_demand(0.2)
    most = halfway_in_years(network, 0.9)
    options: dict[str, Any] = {"network": network, "min_service": 0.9, "at_most": {"emissions": most}}
    comparison = compare((), ("mpc", "best_constant"), tune=24, episodes=48, bounds=False, **options)
    rows = {row.name: row for row in comparison.rows}
    calibration_ = rows["mpc"].entries[0].calibration
    assert calibration_ is not None and calibration_.miss < 0.02
    (level,), amount = rows["mpc"].levels(), rows["mpc"].accounts()[1]
    assert abs(level.value - 0.9) < 0.05
    assert amount.value < 1.01 * most < rows["best_constant"].accounts()[1].value


def test_comparisons_with_budgets_that_cannot_be_meant_are_refused() -> None:
    """Nobody who keeps budgets, an account that is not there, margins on budgets where there are none."""
    network = with_random_demand(0.2)
    with pytest.raises(CirlError, match=r"at_most: none of \['neutral', 'random'\] keeps budgets; add one of mpc, "):
        compare((), network=network, at_most={"emissions": 1e3}, episodes=2)
    with pytest.raises(CirlError, match=r"unknown account 'emission'\. Did you mean 'emissions'"):
        compare((), ("mpc",), network=network, at_most={"emission": 1e3}, episodes=2)
    for name, budgets in (("mpc", None), ("optimum", {"emissions": 1e3})):
        with pytest.raises(CirlError, match="budget_margin 2 goes with at_most and mpc or scenario_mpc"):
            named_controller(name, budget_margin=2.0, at_most=budgets)
    with pytest.raises(CirlError, match="budget_margin 0 must be positive"):
        MPC(budget_margin=0)


def test_a_budget_of_a_disturbed_episode_costs_more_beyond_its_plan_than_below() -> None:
    """(1 − ε)p and (1 + ε)p, times the margin; what is beyond a year costs ten times what it does in the plan.

    What costs nothing in the plan of the expected episode has the least price if it is exceeded all the same.
    """
    network = with_random_demand(0.3)
    env = MultiAgentVectorEnv(network, num_envs=1)
    budgets = {"emissions": halfway_in_years(network, 0.9), "emissions/year": 1e5, "cost": 1e9}
    control = MPC(min_service=0.9, at_most=budgets, budget_margin=2.0)
    env.reset(seed=0)
    control.start(env, 0)
    outlook, plan = control._common_outlook, control._plans[0].window
    assert outlook is not None and plan is not None
    charges, (episode, *years, cost) = outlook.charges, range(8)
    assert charges[episode] > 0 and charges[cost] == 0.0
    paid = plan.task.charges
    assert paid[episode] == pytest.approx(2.0 * 0.5 * charges[episode])
    np.testing.assert_array_equal(paid[years], 0.0)  # each year is one interval, which a window has in full
    beyond = plan.task.price[:8]
    assert paid[episode] + beyond[episode] == pytest.approx(2.0 * 1.5 * charges[episode])
    np.testing.assert_allclose(beyond[years], 10.0 * outlook.task.price[years])
    assert beyond[cost] == pytest.approx(2.0 * 0.1 * network.objective.circularity_scale)
