"""Plans as tables: physical units, the same episode as a rollout, whole files."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from small_networks import constant

from cirl_marl import bound, load_network, plan
from cirl_marl.controllers import Constant, Neutral, Random
from cirl_marl.controllers.rollout import first_seed, rollout
from cirl_marl.controllers.schedule import schedule
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError


def test_neutral_plan_holds_the_neutral_controls() -> None:
    """Valve factors and orders are the definition's neutral values, at every interval, in its units."""
    env = MultiAgentVectorEnv("copper_net", num_envs=1, horizon=4)
    found = schedule(env, Neutral())
    table = dict(zip(found.header, found.columns, strict=True))
    np.testing.assert_allclose(table["from (day)"], [0.0, 0.25, 0.5, 0.75])
    np.testing.assert_allclose(table["to (day)"], [0.25, 0.5, 0.75, 1.0])
    for agent in env.agents:
        control = env.network.compartments[agent].control
        assert control is not None
        column = {"rate": "valve factor (1)", "flow": "flow ordered (kt/day)"}[control.kind.value]
        np.testing.assert_allclose(table[f"{agent}: {column}"], constant(control.neutral))
    np.testing.assert_array_equal(table["mean circularity (kt)"], found.rollout.circularity_mean[0])
    stocks = np.array([table[f"stock of {node.id} at the end (kt)"] for node in env.network.stores])
    np.testing.assert_array_equal(stocks.T, found.rollout.stock)


@pytest.mark.parametrize("demand", [None, 0.9])
@pytest.mark.sample(1)
def test_a_plan_says_what_bounds_it(demand: float | None) -> None:
    """The λ̄ that it names is a bound for the service of the plan, above the plan by the gap that it names."""
    network = load_network("copper_net").with_options(episode={"horizon": 6})
    found = plan(network, "optimum", min_service=demand)
    achieved, service = float(found.rollout.episode_circularity[0]), float(found.rollout.episode_service[0])
    match = re.search(r"λ̄ ≤ (\S+) kt, gap (\S+)%$", found.proof)
    assert match is not None and found.proof in str(found).splitlines()
    limit, share = float(match[1]), float(match[2]) / 100
    assert share == pytest.approx((limit - achieved) / abs(limit), abs=2e-4) and 0 <= share < 0.2
    least = service - 1e-6 if demand is None else demand
    assert bound(network, found.episode_start.initial_state, min_service=least).objective <= limit + 2e-3 * abs(limit)
    assert plan(network, "neutral").proof == ""


def test_orders_have_the_unit_of_a_flow() -> None:
    """A control that sets a flow is tabulated in mass/time, at the value that the action stands for."""
    env = MultiAgentVectorEnv("carbo_net", num_envs=1, horizon=2)
    agent, control = next(
        (a, c) for a in env.agents if (c := env.network.compartments[a].control) is not None and c.kind.value == "flow"
    )
    found = schedule(env, Constant({agent: 1.0}))
    unit = f"{env.network.mass_unit}/{env.network.time_unit}"
    column = found.columns[found.header.index(f"{agent}: flow ordered ({unit})")]
    np.testing.assert_allclose(column, constant(control.high))


def test_inputs_of_models_are_named() -> None:
    """Inputs carry the name of the model, which ends in the unit; the physics runs from mid-range stocks."""
    found = schedule(MultiAgentVectorEnv("net_zero", num_envs=1, horizon=3), Neutral())
    assert {"digester: dilution_per_day", "microalgae: light_umol_m2_s"} <= set(found.header)
    assert np.isfinite(found.columns).all()


def test_batches_are_no_outflow() -> None:
    """What leaves a node in batches is not counted as its outflow, of which their arrivals would be no measure."""
    found = schedule(MultiAgentVectorEnv("solids_net", num_envs=1, scenario="reacher", horizon=3), Neutral())
    assert any(name.startswith("sorter: ") for name in found.header)
    assert not any("total outflow" in name for name in found.header)


def test_seeded_plan_is_an_episode_of_the_evaluation() -> None:
    """With a seed the plan is the first episode that an evaluation with this seed sees; else it starts mid-range."""
    env = MultiAgentVectorEnv("copper_net", num_envs=1, horizon=3)
    found = schedule(env, Random(), seed=2)
    again = rollout(env, Random(), seed=first_seed(2))
    np.testing.assert_array_equal(found.rollout.circularity, again.circularity)
    assert not np.array_equal(schedule(env, Neutral()).rollout.stock, schedule(env, Neutral(), seed=2).rollout.stock)


def test_file(tmp_path: Path) -> None:
    """A header and a row for each interval; no folder, no file."""
    found = schedule(MultiAgentVectorEnv("copper_net", num_envs=1, horizon=5), Neutral())
    found.write(tmp_path / "plan.csv")
    with (tmp_path / "plan.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert tuple(header) == found.header
    np.testing.assert_allclose(np.array(rows, dtype=float).T, found.columns, rtol=1e-9)
    with pytest.raises(CirlError, match="does not exist"):
        found.write(tmp_path / "no" / "plan.csv")


def test_several_copies_are_refused() -> None:
    """A plan is of one episode."""
    with pytest.raises(CirlError, match="of one copy"):
        schedule(MultiAgentVectorEnv("copper_net", num_envs=2), Neutral())
