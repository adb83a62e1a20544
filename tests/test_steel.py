"""The steel of 30 countries: what is reported comes back, what was discarded, and a future that is served."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from benchmarks import steel
from benchmarks.steel import PRIMARY, RAW_EXPORTS, SECTORS, SPLITS, TABLE, YEARS, Country, countries, pasts, simulated
from cirl_marl import MultiAgentVectorEnv, NetworkError, load_network
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import episode_start, rollout
from cirl_marl.definitions.catalogue import families
from cirl_marl.importing.definition import identifiers
from cirl_marl.importing.flow_table import read_flows
from cirl_marl.network.elements import Role
from cirl_marl.optimum import bound, gap, improve_plan, simulate_plan

NETWORKS = families()["steel"]


@pytest.fixture(scope="module")
def everyone() -> list[Country]:
    """Return the flows of all countries."""
    return sorted(countries(read_flows(TABLE)), key=lambda each: each.name)


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


def test_the_data_files_are_of_the_table(
    everyone: list[Country], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Written again from the published table and from what is known of simulations, they are the same."""
    with (steel.ENVS / "steel_regions.csv").open(encoding="utf-8", newline="") as file:
        rows = {row.pop("region"): {name: float(cell) for name, cell in row.items()} for row in csv.DictReader(file)}
    known = {
        name: {key: row[key] for key in ("collection", "stock_scale", "growth", "exports")}
        for name, row in rows.items()
    }
    pooled = {arc: np.sum([each.flows[arc] for each in everyone], axis=0) for arc in everyone[0].flows}
    kept = {name: (steel.ENVS / name).read_text() for name in ("steel.csv", "steel_regions.csv", "steel_demand.csv")}
    monkeypatch.setattr(steel, "ENVS", tmp_path)
    steel.write_flows(everyone, pooled)
    steel.write_regions(everyone, pooled, known)
    steel.write_demand(everyone, pooled, known)
    assert (tmp_path / "steel.csv").read_text() == kept["steel.csv"]
    for name in ("steel_regions.csv", "steel_demand.csv"):
        ours, theirs = (list(csv.reader(text.splitlines())) for text in ((tmp_path / name).read_text(), kept[name]))
        assert ours[0] == theirs[0] and [row[0] for row in ours] == [row[0] for row in theirs]
        given, again = (np.array([[float(cell) for cell in row[1:]] for row in each[1:]]) for each in (ours, theirs))
        np.testing.assert_allclose(given, again, rtol=1e-7)


@pytest.mark.parametrize("network", ["steel_japan", "steel_china"])
def test_discards_are_those_of_cohorts(network: str, everyone: list[Country]) -> None:
    """Of a plain sum over years of what went into use, each with its normal lifetime."""
    found = next(iter(pasts([country(everyone, network)])))
    into_use = found.country.flows["into_use"]
    inflow = np.concatenate([np.full(300, into_use[0]), into_use])
    expected, stock = np.zeros(len(YEARS)), np.zeros(len(YEARS))
    quarter = np.linspace(0, 1, 41)
    middles = (quarter[:-1] + quarter[1:]) / 2
    for part, mean in SECTORS.values():
        ages = np.arange(len(inflow))[:, None]
        # what entered evenly over a year is still there at its end, k years later
        survival = norm.sf(ages + middles, mean, 0.3 * mean).mean(axis=1)
        left = np.array([survival[: n + 1][::-1] @ inflow[: n + 1] for n in range(299, len(inflow))]) * part
        stock += left[1:]
        expected += part * into_use - np.diff(left)
    np.testing.assert_allclose(found.discards, expected, rtol=0.01)
    np.testing.assert_allclose(found.stock, stock, rtol=0.01)


@pytest.mark.medium
def test_hindcasts_beat_persistence(everyone: list[Country]) -> None:
    """By the median of all countries; what is called unreliable follows from 2000-2014 alone."""
    found = pasts(everyone)
    errors = np.array([(each.error(15, steel.TESTED), each.persistence) for each in found])
    assert np.nanmedian(errors[:, 0]) < np.nanmedian(errors[:, 1]) < 0.17
    unreliable = [each.unreliable for each in found]
    assert 5 < sum(unreliable) < 20
    good = ~np.array(unreliable)
    assert np.nanmedian(errors[good, 0]) < np.nanmedian(errors[~good, 0]) / 2
    changed = []
    for past in found:
        scrap = past.country.flows["old_scrap"].copy()
        scrap[15:] = 7.0
        flows = {**past.country.flows, "old_scrap": scrap}
        changed.append(replace(past, country=replace(past.country, flows=flows)).unreliable)
    assert changed == unreliable


@pytest.mark.medium
@pytest.mark.sample(3)
@pytest.mark.parametrize("network", NETWORKS)
def test_business_as_usual_is_served(network: str, everyone: list[Country]) -> None:
    """Primary iron makes up for what the stock in use lacks, and λ counts all of it, imports too."""
    found = load_network(network)
    env = MultiAgentVectorEnv(found, num_envs=1)
    begun = episode_start(env)
    run = rollout(env, Neutral(), seed=begun.seed, start=begun.initial_state)
    flow = {arc.id: run.flow[:, k] for k, arc in enumerate(found.arcs)}
    short = (run.levels[0] < 1 - 1e-6).any(axis=0)
    for arc in PRIMARY:  # something lacks only where all that is ever drawn on gives its most, as in Spain and Thailand
        most = found.control_bounds[2, found.control_rows[arc].start]
        if found.arcs[found.arc_index[arc]].weight:
            np.testing.assert_allclose(flow[arc][short], most[short], rtol=1e-9)
    assert run.levels.min() > 0.99
    assert not short.any() or network in ("steel_spain", "steel_thailand")
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
            'deviation = "15 %"',
            'deviation = "15"',
            "stretch.deviation: must be a number in the unit of the quantity, or relative, as '5 %', got '15'",
        ),
    ],
)
def test_mistakes_are_named(old: str, new: str, said: str, tmp_path: Path) -> None:
    """In services of several compartments, in numbers that stand in files, in relative deviations."""
    for name in ("steel.csv", "steel_regions.csv", "steel_demand.csv"):
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
