"""The steel of 30 countries: what is reported comes back, what was discarded, and a future that is served."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from benchmarks import steel
from benchmarks.steel import (
    EXPORTS,
    IMPORTS,
    PRIMARY,
    RAW_EXPORTS,
    RECENT,
    SECTORS,
    SPLITS,
    TABLE,
    YEARS,
    Calibration,
    Country,
    Files,
    calibrated,
    countries,
    simulated,
)
from benchmarks.steel_calibration import calibrate, cohorts, inflow_of
from benchmarks.steel_hindcast import TESTED, hindcast
from cirl_marl import MultiAgentVectorEnv, NetworkError, load_network
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import episode_start, rollout
from cirl_marl.definitions.catalogue import families
from cirl_marl.importing.definition import identifiers
from cirl_marl.importing.flow_table import read_flows
from cirl_marl.network.elements import Role
from cirl_marl.optimum import bound, gap, improve_plan, simulate_plan

NETWORKS = families()["steel"]
STEEL_FILES = ("steel.csv", "steel_history.csv", "steel_regions.csv", "steel_demand.csv", "steel_copper.csv")


@pytest.fixture(scope="module")
def everyone() -> list[Country]:
    """Return the flows of all countries."""
    return countries(read_flows(TABLE))


def country(everyone: list[Country], network: str) -> Country:
    """Return that of a network."""
    names = identifiers(each.name for each in everyone)
    return next(each for each in everyone if f"steel_{names[each.name]}" == network)


def test_there_are_thirty() -> None:
    """One network a country, from one definition."""
    assert len(NETWORKS) == 30 and {"steel_japan", "steel_turkiye", "steel_south_korea"} <= set(NETWORKS)


@pytest.mark.medium
@pytest.mark.sample(3)
@pytest.mark.parametrize("network", NETWORKS)
def test_what_is_reported_comes_back(network: str, everyone: list[Country]) -> None:
    """Every flow between two processes in every year, within 0.003 kt."""
    flows, _ = simulated(network.removeprefix("steel_"), "reported")
    reported = country(everyone, network).flows
    assert flows.keys() == reported.keys() - {"into_use"}
    for arc, values in flows.items():
        np.testing.assert_allclose(values, reported[arc], rtol=0, atol=0.003, err_msg=arc)


@pytest.mark.sample(3)
@pytest.mark.parametrize("network", NETWORKS)
def test_the_data_files_are_of_the_table(network: str, everyone: list[Country], tmp_path: Path) -> None:
    """Written again from the published tables, for one country alone, they are the same."""
    found = country(everyone, network)
    (tmp_path / "steel.toml").write_bytes((steel.ENVS / "steel.toml").read_bytes())
    Files({found.name: Calibration(*calibrated(found).mode)}, everyone, tmp_path).simulate()
    for name in STEEL_FILES:
        ours, theirs = (
            list(csv.reader((folder / name).read_text(encoding="utf-8").splitlines()))
            for folder in (tmp_path, steel.ENVS)
        )
        kept = [row[1:] for row in theirs if row[0] == found.name]
        assert ours[0] == theirs[0] and {row[0] for row in ours[1:]} == {found.name}
        again, given = (np.array(rows, dtype=float) for rows in ([row[1:] for row in ours[1:]], kept))
        np.testing.assert_allclose(again, given, rtol=1e-7, err_msg=name)


@pytest.mark.medium
@pytest.mark.sample(3)
@pytest.mark.parametrize("network", NETWORKS)
def test_as_usual_goes_on_from_today(network: str, everyone: list[Country]) -> None:
    """Steel, pig iron, scrap and use of 2025 are those of 2020-2024, and nothing jumps afterwards."""
    flows, _ = simulated(network.removeprefix("steel_"), "default")
    reported = country(everyone, network).flows
    for arcs, columns in (
        (["bof_steel", "eaf_steel"], None),
        (["pig_iron_made"], None),
        (["scrap_to_bof", "scrap_to_eaf"], None),
        (["goods_to_use"], ["into_use"]),
    ):
        ours = sum((flows[arc] for arc in arcs), np.zeros(26))
        mean = sum(float(reported[arc][RECENT].mean()) for arc in columns or arcs)
        np.testing.assert_allclose(ours[0], mean, rtol=0.03, atol=1.0, err_msg=str(arcs))
        if arcs != ["pig_iron_made"]:  # which closes the balance, and ends where scrap suffices
            assert np.abs(np.diff(ours)).max() <= 0.1 * ours.mean() + 1.0, arcs
    use = flows["goods_to_use"] / flows["goods_to_use"][0]
    for arc in IMPORTS:
        np.testing.assert_allclose(flows[arc], flows[arc][0] * use, rtol=0.1, atol=50.0, err_msg=arc)
    for arc in EXPORTS:
        np.testing.assert_allclose(flows[arc], flows[arc][0], rtol=0.1, atol=50.0, err_msg=arc)


def test_what_has_to_go_in_gives_the_stock_that_is_wanted() -> None:
    """The inflow of a growing stock, run through the cohorts again."""
    earlier, growth = np.linspace(1.0, 5.0, 60), np.exp(0.02 * np.arange(1, 31))
    inflow = inflow_of(growth, earlier, SECTORS, 1.1)
    _, stock = cohorts(np.concatenate([earlier, inflow]), SECTORS, 1.1)
    np.testing.assert_allclose(stock[60:], growth * stock[59], rtol=1e-9)


@pytest.mark.parametrize("network", ["steel_japan", "steel_china"])
def test_discards_are_those_of_cohorts(network: str, everyone: list[Country]) -> None:
    """Of a plain sum over years of what went into use, each with its normal lifetime; the calibration has them too."""
    found = country(everyone, network)
    flows, stocks = simulated(network.removeprefix("steel_"), "hindcast")
    level, stretch = calibrated(found).mode
    into_use = np.concatenate([level * found.earlier_use, found.flows["into_use"]])
    expected, stock = np.zeros(len(into_use)), np.zeros(len(into_use))
    middles = (np.arange(40) + 0.5) / 40
    for part, mean in SECTORS.values():
        ages = np.arange(len(into_use))[:, None]
        # what entered evenly over a year is still there at its end, k years later
        survival = norm.sf(ages + middles, stretch * mean, 0.3 * stretch * mean).mean(axis=1)
        left = np.array([survival[: n + 1][::-1] @ into_use[: n + 1] for n in range(len(into_use))]) * part
        stock += left
        expected += part * into_use - np.diff(left, prepend=0.0)
    since = slice(-len(YEARS), None)
    np.testing.assert_allclose(flows["old_scrap"] + flows["left"], expected[since], rtol=0.01)
    np.testing.assert_allclose(sum(stocks[sector] for sector in SECTORS), stock[since], rtol=0.01)
    np.testing.assert_allclose(cohorts(into_use, SECTORS, stretch), (expected, stock), rtol=1e-3, atol=1.0)


@pytest.mark.parametrize(("level", "stretch"), [(1.0, 1.0), (1.3, 0.9), (0.8, 1.1)])
def test_a_calibration_finds_what_made_the_data(level: float, stretch: float, everyone: list[Country]) -> None:
    """Collection and stock of old scrap that is made up lie within its ranges, and its collection fits today."""
    found = country(everyone, "steel_japan")
    inflow = np.concatenate([level * found.earlier_use, found.flows["into_use"]])
    discards, stock = cohorts(inflow, SECTORS, stretch)
    scrap = 0.8 * discards[-len(YEARS) :]
    known = calibrate(found.earlier_use, found.flows["into_use"], scrap, SECTORS, years=slice(0, 25), recent=RECENT)
    for truth, values in ((0.8, known.collection), (stock[-1], known.stock)):
        low, high = known.range(values)
        assert low <= truth <= high and high - low < 0.6 * truth
    np.testing.assert_allclose(
        (known.collection[..., None] * known.discards)[..., RECENT].mean(-1), scrap[RECENT].mean()
    )
    assert abs(known.weights.sum() - 1) < 1e-12
    drawn = np.log(known.draws(256))
    mean = (
        known.mean(np.log(known.levels)[:, None] + 0 * known.stock),
        known.mean(np.log(known.stretches) + 0 * known.stock),
    )
    np.testing.assert_allclose(drawn.mean(axis=0), mean, atol=0.02)


def test_old_scrap_beyond_all_discards_is_refused(everyone: list[Country]) -> None:
    """By the country whose flows do not fit."""
    found = country(everyone, "steel_japan")
    flows = {**found.flows, "old_scrap": 5 * found.flows["old_scrap"]}
    with pytest.raises(ValueError, match=r"old scrap is .* of all discards, whatever the history: check the flows"):
        calibrated(replace(found, flows=flows))


def test_hindcasts_know_nothing_of_what_they_predict(everyone: list[Country]) -> None:
    """What is predicted, and what is called unreliable, follows from 2000-2014 alone."""
    found = country(everyone, "steel_japan")
    scrap = found.flows["old_scrap"].copy()
    scrap[TESTED] = 7.0
    ours, theirs = hindcast(found), hindcast(replace(found, flows={**found.flows, "old_scrap": scrap}))
    np.testing.assert_array_equal(ours.predicted, theirs.predicted)
    assert ours.unreliable == theirs.unreliable and ours.earlier == theirs.earlier
    assert ours.errors[0] < 0.1 < theirs.errors[0]


@pytest.mark.medium
@pytest.mark.sample(3)
@pytest.mark.parametrize("network", NETWORKS)
def test_business_as_usual_is_served(network: str, everyone: list[Country]) -> None:
    """Primary iron makes up for what the stock in use lacks, and λ counts all of it, imports too."""
    found = load_network(network)
    env = MultiAgentVectorEnv(found, num_envs=1)
    begun = episode_start(env)
    run = begun.play(env, Neutral())
    flow = {arc.id: run.flow[:, k] for k, arc in enumerate(found.arcs)}
    assert run.levels.min() > 1 - 1e-6
    primary = sum((flow[arc] for arc in PRIMARY), np.zeros(26))
    lost = sum((flow[arc.id] for arc in found.arcs if arc.recipient in ("losses", "uncollected")), np.zeros(26))
    np.testing.assert_allclose(run.circularity_mean[0], -(primary + lost), rtol=1e-9)
    assert (primary >= 0).all() and primary.max() > 0
    assert sum(flow[arc].sum() for arc in RAW_EXPORTS) == 0.0
    later = rollout(
        MultiAgentVectorEnv(load_network(network, scenario="high_circularity"), num_envs=1),
        Neutral(),
        start=begun.initial_state,
    )
    assert later.episode_circularity[0] > run.episode_circularity[0]


def test_nothing_that_is_imported_is_free() -> None:
    """Ore, pig iron and direct reduced iron come from a reservoir, wherever it lies; scrap does not."""
    network = load_network("steel_japan")
    roles = {node.id: node.role for node in network.nodes}
    for arc in PRIMARY:
        assert roles[network.arcs[network.arc_index[arc]].donor] is Role.NONRENEWABLE_RESERVOIR
    assert roles[network.arcs[network.arc_index["scrap_imports"]].donor] is Role.TECHNOSPHERE
    exports = [network.arcs[k].id for k in network.service_arcs(network.services[1])]
    assert sorted(exports) == ["flat_exports", "goods_exports", "long_exports", "semis_exports"]
    assert {each for arcs in SPLITS.values() for each in arcs} <= set(network.arc_index)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('also = ["vehicles",', 'also = ["vehicle",', "service 'steel_in_use': also: unknown node 'vehicle'. Did you"),
        ('also = ["vehicles",', 'also = ["in_use",', "service 'steel_in_use': also: 'in_use' stores nothing; ask for"),
        ('also = ["vehicles",', 'also = ["construction",', "service 'steel_in_use': also: names 'construction' twice"),
        ('column = "stock_scale"', 'column = "stock_scal"', "unknown column 'stock_scal'. Did you mean 'stock_scale'"),
        (
            'stock = { file = "steel_regions.csv", column = "stock_scale"',
            'stock = { file = "steel.csv", column = "into_use"',
            "scales.stock: cannot change in time; fix the time, too, in 'where'",
        ),
        (
            'deviation = "10 %"',
            'deviation = "10"',
            "stretch.deviation: must be a number in the unit of the quantity, or relative, as '5 %', got '10'",
        ),
    ],
)
def test_mistakes_are_named(old: str, new: str, said: str, tmp_path: Path) -> None:
    """In services of several compartments, in numbers that stand in files, in relative deviations."""
    for name in STEEL_FILES:
        (tmp_path / name).write_bytes((steel.ENVS / name).read_bytes())
    text = (steel.ENVS / "steel.toml").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "steel.toml").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(NetworkError) as refused:
        load_network(f"{tmp_path / 'steel.toml'}:japan")
    assert said in str(refused.value)


@pytest.mark.slow
@pytest.mark.parametrize("network", ["steel_japan", "steel_brazil"])
def test_plans_come_to_the_bound(network: str) -> None:
    """Within 1 %, at full service."""
    found = bound(network, min_service=1.0)
    run = simulate_plan(improve_plan(found))
    assert run.levels.mean(axis=2).min() > 1 - 1e-6
    assert 0 <= float(gap(found.objective, run.episode_circularity[0])) < 0.01
