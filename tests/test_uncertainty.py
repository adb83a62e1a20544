"""Numbers that nobody knows exactly: what is drawn, bands of episodes, and which number causes them."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from cirl_marl import Arc, CirlError, Episode, Law, Network, NetworkError, Node, Role, Series, VectorEnv, load_network
from cirl_marl.cli import app
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import rollout
from cirl_marl.definitions.reading import write_network
from cirl_marl.evaluation.sampling import sampled, sensitivities
from cirl_marl.network.uncertainty import Spread, drawn

EXAMPLE = Path(__file__).parent.parent / "examples" / "metal_cycle.toml"


def line(uncertain: dict[str, Spread], **rates: Any) -> Network:
    """Return a mine, whose ore is shared out between a dump and a store that leaks."""
    flow = {"flow": 10.0, "dumped": 0.2, "leak": 0.1} | rates
    return Network(
        name="line",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(1e4, 1e4)),
            Node(id="mill", stores=False),
            Node(id="store", initial=(50.0, 50.0)),
            Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="dig", donor="mine", recipient="mill", law=Law.EXOGENOUS, flow=flow["flow"]),
            Arc(id="tails", donor="mill", recipient="dump", law=Law.SHARE, share=flow["dumped"]),
            Arc(id="metal", donor="mill", recipient="store", law=Law.SHARE, share=flow.get("kept")),
            Arc(id="leak", donor="store", recipient="dump", rate=flow["leak"]),
        ),
        episode=Episode(horizon=4),
        uncertain=uncertain,
    )


@pytest.mark.parametrize(
    ("spread", "law"),
    [
        (Spread(deviation=0.2), stats.truncnorm(-4, 4, 1.0, 0.2)),
        (Spread(deviation=0.5, low=0.5, high=2.0), stats.truncnorm(-1, 2, 1.0, 0.5)),
        (Spread(low=0.7, high=1.1, distribution="uniform"), stats.uniform(0.7, 0.4)),
        (
            Spread(deviation=0.3, distribution="lognormal"),
            stats.lognorm(np.sqrt(np.log(1.09)), scale=1 / np.sqrt(1.09)),
        ),
    ],
)
def test_draws_follow_their_distribution(spread: Spread, law: Any) -> None:
    """That of SciPy, cut to the range."""
    draws = spread.at(np.random.default_rng(0).random(4000))
    assert stats.kstest(draws, law.cdf).pvalue > 1e-3
    assert draws.min() >= spread.low and draws.max() <= spread.high


def test_a_draw_is_the_network_with_other_numbers() -> None:
    """Numbers are multiplied, series at all times; the rest of a split makes room; the network itself stays."""
    twice = Spread(low=1.0, high=2.0, distribution="uniform")
    flow = Series(times=(0.0, 2.0), values=(10.0, 4.0))
    network = line({"arcs.dig.flow": twice, "arcs.leak.rate": twice, "arcs.tails.share": twice}, flow=flow)
    found = drawn(network, [1.0, 0.5, 1.0])
    dig, tails, metal, leak = found.arcs
    assert dig.flow == replace(flow, values=(20.0, 8.0)) and leak.rate == pytest.approx(0.15)
    assert tails.share == pytest.approx(0.4) and metal.share is None
    assert not found.uncertain and network.arcs[0].flow == flow
    run = rollout(VectorEnv(found, num_envs=1), Neutral())
    np.testing.assert_allclose(run.flow[:, 1], 0.4 * np.array([20.0, 20.0, 8.0, 8.0]))


def test_shares_stay_shares() -> None:
    """Where all are stated they are divided by their sum; where one takes the rest it is never less than none."""
    wide = Spread(low=0.1, high=9.0, distribution="uniform")
    stated = drawn(line({"arcs.tails.share": wide}, kept=0.8), [1.0])
    assert stated.arcs[1].share == pytest.approx(1.8 / 2.6) and stated.arcs[2].share == pytest.approx(0.8 / 2.6)
    little = drawn(line({"arcs.tails.share": wide}, kept=0.8), [0.0])
    assert little.arcs[1].share == pytest.approx(0.02 / 0.82) and little.arcs[2].share == pytest.approx(0.8 / 0.82)
    rest = drawn(line({"arcs.tails.share": wide}), [1.0])
    assert rest.arcs[1].share == pytest.approx(1.0)
    assert drawn(line({"arcs.tails.share": wide}), [0.0]).arcs[1].share == pytest.approx(0.02)


def test_samples_are_single_simulations() -> None:
    """Of what was drawn; more samples add to those before."""
    uncertain = {"arcs.dig.flow": Spread(deviation=0.1), "arcs.leak.rate": Spread(deviation=0.2)}
    network = line(uncertain)
    found, more = sampled(network, samples=3, seed=4), sampled(network, samples=5, seed=4)
    np.testing.assert_array_equal(more.circularity[:3], found.circularity)
    for i, (dug, leaked) in enumerate(found.factors.tolist()):
        run = rollout(VectorEnv(line({}, flow=10.0 * dug, leak=0.1 * leaked), num_envs=1), Neutral())
        np.testing.assert_allclose(found.stock[i], run.stock, rtol=1e-12)
        np.testing.assert_allclose(found.flow[i], run.flow, rtol=1e-12)
        np.testing.assert_allclose(found.circularity[i], run.circularity_mean[0], rtol=1e-12)
    assert not np.array_equal(sampled(network, samples=3, seed=5).factors, found.factors)


def test_causes_are_the_shares_of_the_variance() -> None:
    """λ̄ = −(dug + leaked): of two flows in a sum each causes its part, in closed form; what has no part, none."""
    uncertain = {
        "arcs.dig.flow": Spread(deviation=0.1),
        "arcs.leak.rate": Spread(deviation=0.4),
        "nodes.other.rate": Spread(deviation=0.4),
    }
    network = line({})
    other = Node(id="other", initial=(5.0, 5.0), rate=0.2)
    apart = Arc(id="apart", donor="other", recipient="store", law=Law.SHARE)
    network = replace(
        network, nodes=(*network.nodes, other), arcs=(*network.arcs, apart), uncertain=uncertain
    ).with_options(episode={"horizon": 1})
    found = sampled(network, samples=300)
    (causes,) = sensitivities(found)
    parts = []
    for k in range(2):
        shares = np.full((2, 3), 0.5)
        shares[:, k] = stats.norm.cdf([-1, 1])
        low, high = (
            rollout(VectorEnv(drawn(network, each.tolist()), num_envs=1), Neutral()).episode_circularity[0]
            for each in shares
        )
        parts.append(((high - low) / 2) ** 2)
    expected = np.array([*parts, 0.0]) / sum(parts)
    np.testing.assert_allclose(causes.shares, expected, atol=0.15)
    assert (np.abs(causes.shares - expected) < 2.5 * causes.margins + 0.02).all()


def test_files_state_it(tmp_path: Path) -> None:
    """Deviation and range in the unit of the number; written, they read back the same."""
    network = load_network(EXAMPLE).scenario("business_as_usual")
    assert set(network.uncertain) == {"arcs.dross.share", "nodes.use.stretch", "services.supply.low"}
    assert network.uncertain["arcs.dross.share"] == Spread(low=0.5, high=1.5, distribution="uniform")
    assert network.uncertain["services.supply.low"].deviation == pytest.approx(0.05)
    write_network(network, tmp_path / "again.toml")
    again = load_network(str(tmp_path / "again.toml"))
    for where, spread in network.uncertain.items():
        other = again.uncertain[where]
        assert (other.low, other.deviation) == pytest.approx((spread.low, spread.deviation))
    np.testing.assert_allclose(sampled(again, samples=2).circularity, sampled(network, samples=2).circularity)


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("range = [1.5, 0.5]", r"arcs.dross.share.range: \[1.5, 0.5\] must have its lower end first, 1"),
        ("range = [1.2, 1.5]", r"range: \[1.2, 1.5\] must contain the number, 1"),
        ("deviation = -1", r"arcs.dross.share: deviation -1: what spreads, and its deviation, must be positive"),
        ('distribution = "normal"', r"arcs.dross.share.distribution: 'normal' needs a deviation or a range"),
        ('range = [0.5, 1.5], distribution = "norml"', r"Did you mean 'normal'"),
        ('range = [0.5, 1.5], distribution = "normal"', r"distribution 'normal' needs a deviation"),
    ],
)
def test_what_cannot_spread_is_refused(written: str, said: str, tmp_path: Path) -> None:
    """With its path, what is wrong and what to do."""
    text = EXAMPLE.read_text().replace("range = [0.5, 1.5]", written)
    (tmp_path / "metal_cycle.csv").write_text(EXAMPLE.with_suffix(".csv").read_text())
    (tmp_path / "metal_cycle.toml").write_text(text)
    with pytest.raises(NetworkError, match=said):
        load_network(str(tmp_path / "metal_cycle.toml"))


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ("arcs.dig.flw", r"of arcs these can be uncertain: rate, share, flow; 'flw' cannot"),
        ("arcs.dg.flow", r"unknown arc 'dg'. Did you mean 'dig'"),
        ("episode.horizon", r"only numbers of nodes, arcs, services can be uncertain"),
        ("arcs.metal.share", r"'share' is not given"),
        ("arcs.dig.rate", r"it is 0, and so is every draw"),
    ],
)
def test_paths_are_checked(where: str, said: str) -> None:
    """Of networks made in Python."""
    with pytest.raises(NetworkError, match=said):
        line({where: Spread(deviation=0.1)})


def test_the_command_writes_bands_and_causes(tmp_path: Path) -> None:
    """Quantiles in order, those of the draws; nothing is written of what is refused."""
    run = CliRunner().invoke(app, ["simulate", str(EXAMPLE), "--samples", "80", "--steps", "3", "--out", str(tmp_path)])
    assert run.exit_code == 0, run.output
    files = sorted(path.name for path in tmp_path.iterdir())
    assert files == [f"metal_cycle_neutral_{each}" for each in ("bands.csv", "bands.png", "causes.csv", "draws.csv")]
    with (tmp_path / "metal_cycle_neutral_bands.csv").open(newline="") as file:
        bands = list(csv.DictReader(file))
    assert len(bands) == 3 * (1 + 1 + 3 + 8)
    for row in bands:
        quantiles = [float(row[f"quantile {each}"]) for each in ("0.025", "0.25", "0.5", "0.75", "0.975")]
        assert quantiles == sorted(quantiles)
    with (tmp_path / "metal_cycle_neutral_causes.csv").open(newline="") as file:
        (first, *_) = list(csv.DictReader(file))
    assert first["number"] == "arcs.dross.share" and float(first["share of λ̄"]) > 0.8
    for arguments, said in (
        (["copper_net", "--samples", "80"], "nothing is uncertain"),
        (
            [str(EXAMPLE), "--samples", "80", "--control", "neutral", "--control", "random"],
            "one scenario and one control",
        ),
    ):
        refused = CliRunner().invoke(app, ["simulate", *arguments, "--out", str(tmp_path / "other")])
        assert refused.exit_code != 0 and said in str(refused.exception)
    assert not (tmp_path / "other").exists()
    with pytest.raises(CirlError, match="too few to tell"):
        sensitivities(sampled(load_network(EXAMPLE).with_options(episode={"horizon": 2}), samples=3))
