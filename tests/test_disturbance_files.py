"""Disturbances in definitions, commands and pages: what is refused, what is written, and what is told of them."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from disturbed_line import EVERYWHERE, line, works
from scipy import stats
from small_networks import CORRELATION, KINDS
from typer.testing import CliRunner

from cirl_marl import (
    Control,
    ControlKind,
    DefinitionError,
    MultiAgentVectorEnv,
    NetworkError,
    load_network,
)
from cirl_marl.cli import app
from cirl_marl.controllers.rollout import first_seed
from cirl_marl.definitions.reader import write_network
from cirl_marl.evaluation import compare
from cirl_marl.evaluation.sampling import sample_episodes
from cirl_marl.evaluation.statistics import worst_mean
from cirl_marl.network.disturbances import (
    AutoRegression,
    BlockBootstrap,
    Correlation,
    Disturbance,
    DisturbanceEffect,
    Markov,
)
from cirl_marl.network.uncertainty import CAPACITY, Spread
from cirl_marl.report.page_data import page_data
from cirl_marl.report.report_page import page_of_samples
from cirl_marl.report.tradeoffs import comparison_notes, summary_of, worst_notes


def test_capacities_in_files(tmp_path: Path) -> None:
    """A control says what disturbs it; bounds that would cross, and bounds that are no capacity, are refused."""
    effect = {f"arcs.dig.{CAPACITY}": DisturbanceEffect(by="outage")}
    network = replace(works(), disturbances={"outage": KINDS["outage"]}, disturbed=effect)
    path = tmp_path / "works.toml"
    write_network(network, path)
    assert load_network(path).disturbed == effect
    text = path.read_text()
    assert text.count('disturbed_by = "outage"') == 1
    for old, new, message in (
        ("high = 8.0", "high = 6.0", None),
        ("values = [1.0, 0.4, 0.7]", "values = [1.0, 0.1, 0.7]", "'outage' it may be 0.8, below control.low 1; lower"),
        ('disturbed_by = "outage"', 'disturbed_by = "outrage"', "disturbed_by: .*Did you mean 'outage'"),
        ("rate = {value = 0.2", 'rate = {disturbed_by = "outrage", value = 0.2', "Did you mean 'outage'"),
        ("initial = {", 'initial = {disturbed_by = "outage", ', "initial.disturbed_by: only rates, flows, shares"),
        (
            "rate = {value = 0.2",
            'rate = {multiplied_by = {value = 2.0, unit = "1", source = "x", disturbed_by = "outage"}, value = 0.2',
            "rate.multiplied_by.disturbed_by: belongs beside it",
        ),
    ):
        assert old in text
        path.write_text(text.replace(old, new, 1))
        if message is None:
            load_network(path)
        else:
            with pytest.raises(DefinitionError, match=message):
                load_network(path)
    scenario = '[scenarios.hazards.nodes.furnace.control]\ndisturbed_by = "outage"\n'
    path.write_text(f"{text}\n{scenario}")
    assert f"nodes.furnace.{CAPACITY}" in load_network(path, scenario="hazards").disturbed
    shares = replace(line({}), disturbances=KINDS)
    tails = replace(shares.arcs[1], share=None, control=Control(kind=ControlKind.SHARE, low=0.0, neutral=0.1, high=0.2))
    shares = replace(shares, arcs=(shares.arcs[0], tails, *shares.arcs[2:]))
    for part, message in (
        ("arcs.tails", "a control of kind 'share' has no capacity: shares are parts of a whole"),
        ("arcs.leak", "arcs.leak.control.high: it has no control"),
        ("services.metal_kept", "unknown number of services that can be .* Did you mean 'high'. Known: low, high"),
    ):
        with pytest.raises(NetworkError, match=message):
            replace(shares, disturbed={f"{part}.{CAPACITY}": DisturbanceEffect(by="outage")})
    with pytest.raises(NetworkError, match="can be disturbed in time, but not drawn"):
        replace(works(), uncertain={f"arcs.dig.{CAPACITY}": Spread(low=0.9, high=1.1, distribution="uniform")})


def test_both_ends_of_a_band_may_move_together() -> None:
    """As one disturbance never turns the band; two may."""
    network = line({})
    band = replace(network.services[0], high=55.0)
    ends = {f"services.metal_kept.{end}": DisturbanceEffect(by="record") for end in ("low", "high")}
    moved = replace(network, services=(band,), disturbed=ends)
    env = MultiAgentVectorEnv(moved, num_envs=2)
    env.reset(seed=0, options={"initial_state": {"mine": 20.0, "store": 70.0}})
    outcome = env.advance(np.empty((0, 2)))
    store = env.rows.stocks(env.physical.stock)[moved.node_index["store"]]
    np.testing.assert_allclose(outcome.levels[0], np.minimum(1.0, 55.0 * env.physical.disturbances[0, 0] / store))
    other = {**ends, "services.metal_kept.high": DisturbanceEffect(by="outage")}
    with pytest.raises(NetworkError, match=r"metal_kept.high: disturbed by 'outage': some draws turn the band"):
        replace(network, services=(band,), disturbed=other)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"outage": replace(KINDS["outage"], matrix=((1.0, 0, 0), (0.5, 0.5, 0), (0, 0, 1.0)))}, "never returns to"),
        ({"outage": replace(KINDS["outage"], matrix=((0.5, 0.4, 0), (0.5, 0.5, 0), (0, 1, 0)))}, "row 1: .* sum to 1"),
        (
            {"outage": Markov(values=(1.0, 0.5), lengths=(5.0, 0.5))},
            "lengths: needs 2 numbers of intervals, at least 1",
        ),
        ({"outage": Markov(values=(1.0, 0.5))}, "give either the matrix or the lengths"),
        ({"price": AutoRegression(deviation=0.3, persistence=1.0)}, "persistence 1 must lie between -1 and 1"),
        (
            {"price": AutoRegression(deviation=0.3, persistence=0.5)},
            r"arcs.dig.flow: disturbed by 'price' it may be -0.2",
        ),
        ({"price": AutoRegression(deviation=0.3, persistence=0.5, low=2.0, high=1.0)}, "low 2 must lie below high 1"),
        ({"price": replace(KINDS["price"], observed="none")}, "price: forecast: it is hidden"),
        ({"price": replace(KINDS["price"], delayed=1)}, "price: forecast: .* leave one of the two out"),
        (
            {"price": replace(KINDS["price"], forecast=-1)},
            "forecast -1: must be a number of intervals, 0 to 1000",
        ),
        (
            {"price": replace(KINDS["price"], observed_by=("stor",))},
            "observed_by: unknown agent 'stor'. Did you mean 'store'",
        ),
        ({"walk": replace(KINDS["walk"], start=2.0)}, r"walk: start 2 must lie in \[0.7, 1.3\]"),
        ({"walk": replace(KINDS["walk"], high=np.inf)}, "walk: high inf must be finite"),
        ({"price": replace(KINDS["price"], low=-np.inf)}, "price: low -inf must be finite"),
        ({"outage": replace(KINDS["outage"], values=(1.0, np.inf, 0.4))}, "outage: values: value 2, inf, must be fin"),
        ({"season": replace(KINDS["season"], profile=(np.nan, 1.0))}, "season: profile: value 1, nan, must be finite"),
        ({"record": replace(KINDS["record"], values=(1.0, 0.9, -np.inf))}, "record: values: value 3, -inf, must be"),
        ({"outage": Markov(values=(), lengths=())}, "outage: values: a chain has at least two regimes, got 0"),
        ({"season": replace(KINDS["season"], profile=())}, "season: profile: needs at least one value"),
        ({"record": replace(KINDS["record"], values=())}, "record: values: a record has at least two values, got 0"),
    ],
)
def test_mistakes_of_disturbances_are_named(changes: dict[str, Disturbance], message: str) -> None:
    """By name and number."""
    with pytest.raises(NetworkError, match=message):
        line(EVERYWHERE, {**KINDS, **changes})


@pytest.mark.parametrize(
    ("disturbed", "correlation", "message"),
    [
        ({"arcs.dig.flow": DisturbanceEffect(by="prise")}, None, "arcs.dig.flow: disturbed_by: .*Did you mean 'price'"),
        ({"arcs.dig.flw": DisturbanceEffect(by="price")}, None, "uncertain or disturbed 'flw'. Did you mean 'flow'"),
        ({"arcs.leak.flow": DisturbanceEffect(by="price")}, None, "arcs.leak.flow: it is 0"),
        (
            {"nodes.store.stretch": DisturbanceEffect(by="price")},
            None,
            "only a lifetime with a deviation can be stretched",
        ),
        ({}, Correlation(names=("price", "outage"), matrix=((1, 0), (0, 1))), "'outage' is of kind 'markov'"),
        ({}, Correlation(names=("price", "ore"), matrix=((1, 0.5), (0.4, 1))), "is no correlation: symmetric"),
        ({}, Correlation(names=(), matrix=()), "names: needs two disturbances or more, got 0"),
        (
            {},
            Correlation(names=("price", "ore", "walk"), matrix=((1, 0.9, -0.9), (0.9, 1, 0.9), (-0.9, 0.9, 1))),
            "nothing is correlated like that",
        ),
        ({}, Correlation(names=("price", "ore"), matrix=((1,),)), "needs 2 rows of 2 numbers"),
    ],
)
def test_mistakes_of_what_is_disturbed_are_named(
    disturbed: dict[str, DisturbanceEffect], correlation: Correlation | None, message: str
) -> None:
    """By path, or by the table of correlations."""
    with pytest.raises(NetworkError, match=message):
        line(disturbed, correlation=correlation)


def test_a_file_says_all_of_it(tmp_path: Path) -> None:
    """What is written reads back to the last bit; a scenario that says what disturbs a quantity keeps its number."""
    network = line(EVERYWHERE, correlation=CORRELATION)
    path = tmp_path / "line.toml"
    write_network(network, path)
    again = load_network(path)
    assert again.disturbances == network.disturbances and again.disturbed == network.disturbed
    assert again.correlation == CORRELATION
    (tmp_path / "record.csv").write_text("year,grade\n1,1.0\n2,0.8\n3,1.1\n")
    source = 'source = "measured"'
    text = (
        path.read_text()
        + f"""
[scenarios.hazards]
without = ["disturbances.record"]

[scenarios.hazards.disturbances.grade]
kind = "resampled"
values = {{ file = "record.csv", column = "grade" }}
block = 2
unit = "1"
{source}

[scenarios.hazards.disturbances.flood]
kind = "markov"
values = [0.0, 24.0]
lengths = [9, 1]
unit = "kg/hour"
{source}

[scenarios.hazards.arcs.dig]
flow = {{ disturbed_by = "flood", disturbed_as = "summand" }}

[scenarios.hazards.services.metal_kept]
low.disturbed_by = "grade"
"""
    )
    path.write_text(text)
    hazards = load_network(path, scenario="hazards")
    assert hazards.arcs[0].flow == 10.0
    assert hazards.disturbed["arcs.dig.flow"] == DisturbanceEffect(by="flood", adds=True, scale=24.0)
    assert hazards.disturbances["grade"] == BlockBootstrap(values=(1.0, 0.8, 1.1), block=2.0)
    assert hazards.disturbed["services.metal_kept.low"].by == "grade" and "record.csv" in hazards.data_sha256
    for old, new, message in (
        ('kind = "resampled"', 'kind = "resampledd"', "record.kind: .*Did you mean 'resampled'"),
        ("block = 2\n", "", r"scenarios.hazards.disturbances.grade.block: missing"),
        ('"kg/hour"', '"kg"', "flood', which is added: unit 'kg' is inconsistent"),
        (', disturbed_as = "summand"', "", "'flood' has unit 'kg/hour': a factor has unit '1'"),
        ('column = "grade"', 'column = "grad"', "Did you mean 'grade'"),
        ("lengths = [9, 1]", "length = [9, 1]", "Did you mean 'lengths'"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(DefinitionError, match=message):
            load_network(path, scenario="hazards")


@pytest.mark.medium
def test_the_command_shows_what_happened(tmp_path: Path) -> None:
    """Values of each interval in the table of an episode; bands of them, and means of draws, of many."""
    path = tmp_path / "line.toml"
    write_network(line(EVERYWHERE), path)
    shown = CliRunner().invoke(app, ["simulate", str(path), "--out", str(tmp_path)])
    assert shown.exit_code == 0, shown.output
    (table,) = tmp_path.glob("*neutral.csv")
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    env = MultiAgentVectorEnv(load_network(path), num_envs=1)
    env.reset(seed=first_seed(0))
    assert rows[0]["disturbance price (1)"] == ""
    found = [float(row["disturbance price (1)"]) for row in rows[1:]]
    np.testing.assert_allclose(found, env.physical.disturbances[:-1, 0, 0])
    shown = CliRunner().invoke(app, ["show", str(path), "--picture", str(tmp_path / "line.png")])
    assert shown.exit_code == 0 and re.search(r"outage +│ markov +│ +0.4 … 1 +│ now +│ arcs.leak.rate", shown.output)
    shown = CliRunner().invoke(app, ["simulate", str(path), "--samples", "5", "--out", str(tmp_path)])
    assert shown.exit_code == 0, shown.output
    with (tmp_path / "line_neutral_bands.csv").open(newline="") as file:
        bands = [row for row in csv.DictReader(file) if row["quantity"] == "disturbance outage"]
    with (tmp_path / "line_neutral_draws.csv").open(newline="") as file:
        draws = list(csv.DictReader(file))
    samples = load_network(path).processes.sample(range(first_seed(0), first_seed(0) + 5)).values[:-1]
    names = load_network(path).processes.names
    np.testing.assert_allclose([float(row["mean"]) for row in bands], samples[:, names.index("outage")].mean(axis=1))
    data = page_data(page_of_samples(sample_episodes(load_network(path), samples=5), "neutral"))
    assert [part["id"] for part in data["networks"][0]["disturbances"]] == [*names]
    for i, scene in enumerate(data["scenes"][1:]):
        np.testing.assert_allclose([part["value"] for part in scene["disturbances"]], samples[..., i].T, rtol=1e-5)
    found = [float(row["mean of disturbance record (1)"]) for row in draws]
    np.testing.assert_allclose(found, samples[:, names.index("record")].mean(axis=0))


def test_a_scenario_may_have_a_disturbance_of_another_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its table takes the place of the other; who alone sees it is shown, and pictures of draws name the scenario."""
    path = tmp_path / "line.toml"
    write_network(line(EVERYWHERE), path)
    table = '[scenarios.stops.disturbances.price]\nkind = "markov"\nvalues = [1, 0.5]\nlengths = [4, 2]\n'
    path.write_text(f'{path.read_text()}\n{table}unit = "1"\nsource = "x"\nobserved_by = ["leak"]\n')
    network = load_network(path, scenario="stops")
    assert network.disturbances["price"] == Markov(values=(1.0, 0.5), lengths=(4.0, 2.0), observed_by=("leak",))
    assert network.disturbed == load_network(path).disturbed
    shown = CliRunner().invoke(app, ["show", str(path), "--scenario", "stops"])
    assert re.search(r"price +│ markov +│ +0.5 … 1 +│ now, by leak", shown.output)
    titles = list[str]()
    monkeypatch.setattr("cirl_marl.report.samples.save_bands", lambda *_, title, **__: titles.append(title))
    command = ["simulate", str(path), "--samples", "2", "--steps", "2", "--out", str(tmp_path)]
    for options in ([], ["--scenario", "stops"]):
        assert CliRunner().invoke(app, [*command, *options]).exit_code == 0
    assert titles == ["line, neutral control, 2 samples", "line, scenario stops, neutral control, 2 samples"]


@pytest.mark.medium
def test_the_worst_episodes_are_told(tmp_path: Path) -> None:
    """CVaR with a fraction of an episode, its interval, and that of every policy in tables and files."""
    rng = np.random.default_rng(0)
    draws = rng.normal(size=(400, 250))
    tail = stats.norm.pdf(stats.norm.ppf(0.05)) / -0.05
    found = [worst_mean(row) for row in draws]
    for row, figure in zip(draws[:20], found, strict=False):
        lowest = np.sort(row)[:13]
        assert figure.value == pytest.approx((lowest[:12].sum() + 0.5 * lowest[12]) / 12.5)
    assert np.mean([figure.value for figure in found]) == pytest.approx(tail, abs=0.05)
    assert np.mean([figure.low <= tail <= figure.high for figure in found]) > 0.85
    assert worst_mean(np.array([3.0, 1.0, 2.0])).value == 1.0
    network = line(EVERYWHERE)
    comparison = compare((), ("neutral",), network=network, bounds=False)
    assert comparison.episodes == 256 and comparison.ties == ()
    assert compare((), ("neutral",), network=line({}), bounds=False).episodes == 64
    (row,) = comparison.rows
    kept = comparison.entries[0].rollout
    np.testing.assert_array_equal(
        kept.disturbances[3], network.processes.sample([comparison.first_seed + 3]).values[:-1, :, 0]
    )
    circularity, level = row.worst()
    assert circularity.value == worst_mean(kept.episode_circularity).value < kept.episode_circularity.mean()
    assert level.low <= level.value <= level.high and level.value < row.levels()[0].value == kept.episode_levels.mean()
    assert "worst level of metal_kept" in worst_notes(comparison)[0]
    assert summary_of(comparison)["rows"][0]["worst_service_levels"]["metal_kept"]["value"] == level.value
    held = compare((), ("neutral",), network=network.with_options(episode={"horizon": 3}), episodes=3)
    entry = held.entries[0]
    assert entry.bound is not None and (entry.bound >= entry.circularity - 1e-6).all() and np.ptp(entry.bound) > 0.1


@pytest.mark.medium
def test_episodes_are_added_until_differences_can_be_told() -> None:
    """As those of one comparison with as many; random orders are on average those of who is neutral."""
    outage = replace(KINDS["outage"], values=(1.0, 0.05, 0.5))
    disturbed = {"arcs.melt.rate": DisturbanceEffect(by="outage")}
    network = replace(works(4.5), disturbances={"outage": outage}, disturbed=disturbed, default_agents=("dig",))
    clear = compare((), ("neutral", "scripted"), network=replace(network, default_agents=()), bounds=False)
    assert clear.episodes == 256 and clear.ties == ()
    unclear = compare((), ("random",), network=network, bounds=False)
    assert unclear.episodes > 256
    whole = compare((), ("random",), network=network, bounds=False, episodes=unclear.episodes)
    assert whole.ties is None
    entry, other = unclear.entries[0], whole.entries[0]
    assert entry.name == "neutral" and unclear.entries[1].name == "random"
    for name in ("circularity_mean", "levels", "disturbances", "returns", "flow"):
        np.testing.assert_array_equal(getattr(entry.rollout, name), getattr(other.rollout, name))
    np.testing.assert_allclose(entry.rollout.mean_flow, other.rollout.mean_flow, rtol=1e-12)
    difference = unclear.entries[1].circularity - unclear.entries[0].circularity
    wide = 1.96 * difference.std() / np.sqrt(unclear.episodes) > max(abs(difference.mean()), 0.005 * 6)
    assert unclear.episodes == 1024 or not wide
    assert f"episodes: {unclear.episodes}, doubled from 256 to at most 1,024" in comparison_notes(unclear)[0]
