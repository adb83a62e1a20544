"""Pictures and pages in which colours show the content of a substance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from typer.testing import CliRunner

from cirl_marl import CirlError, load_network
from cirl_marl.cli import app
from cirl_marl.drawing.content_colours import STOPS, ContentColours, SubstanceAmounts, contents_of
from cirl_marl.drawing.digraph import save_network
from cirl_marl.drawing.folding import fold_copies
from cirl_marl.drawing.picture import draw_network
from cirl_marl.drawing.style import GOOD, NEUTRAL, ROLE_COLOURS, WARNING
from cirl_marl.evaluation.simulations import simulate_alternatives
from cirl_marl.report.page_data import page_data
from cirl_marl.report.report_page import page_of_alternatives

EXAMPLE = "examples/copper_in_steel.toml"


def test_scales_cover_what_most_of_the_flow_holds() -> None:
    """A trickle of pure copper does not make all else pale; legends say so, in a unit that is read."""
    flow, contents = np.array([50.0, 50.0, 1.0, 0.0]), np.array([0.001, 0.004, 1.0, np.nan])
    colours = ContentColours("copper", contents, flow)
    assert colours.highest == 0.004
    assert [colours.of(x) for x in (0.0, 0.004, 1.0, np.nan)] == [STOPS[0], STOPS[-1], STOPS[-1], NEUTRAL]
    assert [*colours.steps.values()] == ["copper: 0 %", "0.1 %", "0.2 %", "0.3 %", "0.4 % or more"]
    assert colours.of(0.001) == [*colours.steps][1]
    tin = ContentColours("tin", np.array([2e-5, np.nan]), np.array([1.0, 0.0]))
    assert [*tin.steps.values()][1:] == ["5 ppm", "10 ppm", "15 ppm", "20 ppm"]


def test_nothing_has_no_content() -> None:
    """Neither has a network without flows a scale of its own."""
    np.testing.assert_array_equal(contents_of(np.array([1.0, 0.0]), np.array([4.0, 0.0])), [0.25, np.nan])
    assert ContentColours("copper", np.array([np.nan]), np.array([0.0])).highest == 1.0
    assert ContentColours("copper", np.array([0.0]), np.array([1.0])).of(0.0) == STOPS[0]


def test_boxes_and_arrows_have_the_colours_of_their_contents() -> None:
    """By the contents of stocks and throughputs, and of flows; without a substance they stay as they are."""
    network = load_network(EXAMPLE)
    stock, flow = network.initial.mean(axis=0), np.ones(len(network.arcs))
    parts = SubstanceAmounts("copper", stock * 0.001, flow * np.linspace(0.0, 0.002, len(flow)))
    axes = Figure().add_axes((0, 0, 1, 1))
    draw_network(axes, network, stock, flow, substance=parts)
    arrows = next(item for item in axes.collections if isinstance(item, PolyCollection))
    colours = ContentColours("copper", parts.flow, flow)
    assert [to_hex(colour) for colour in np.atleast_2d(arrows.get_facecolor())] == [*map(colours.of, parts.flow)]
    legend = axes.get_legend()
    assert legend is not None
    texts = [text.get_text() for text in legend.get_texts()]
    assert "copper: 0 %" in texts and "nothing" in texts and "flow that lowers λ" not in texts
    assert not {WARNING, GOOD} & {text.get_color() for text in axes.texts}
    levels = [to_hex(patch.get_facecolor()) for patch in axes.patches]
    assert colours.of(0.001) in levels and not {*ROLE_COLOURS.values()} & {*levels}
    draw_network(axes, network, stock, flow)
    assert {*ROLE_COLOURS.values()} & {to_hex(patch.get_facecolor()) for patch in axes.patches}
    with pytest.raises(CirlError, match="flow of the substance has shape"):
        draw_network(axes, network, stock, flow, substance=replace(parts, flow=flow[:2]))


def test_folded_copies_add_up_substances(tmp_path: Path) -> None:
    """What is in a box of a copy is the sum of what is in its stocks, whatever flows without the substance."""
    network = load_network("steel_world", scenario="copper")
    rng = np.random.default_rng(0)
    stock, flow = rng.uniform(1, 2, len(network.stores)), rng.uniform(1, 2, len(network.arcs))
    parts = stock * 0.1, np.where(rng.random(len(flow)) < 0.5, 0.0, flow * 0.2)
    folded, stocks, flows = fold_copies(
        network, np.stack([stock, parts[0]], axis=1), np.stack([flow, parts[1]], axis=1)
    )
    alone, stocks_alone, flows_alone = fold_copies(network, stock, flow)
    assert [arc.id for arc in folded.arcs] == [arc.id for arc in alone.arcs]
    np.testing.assert_allclose(stocks, np.stack([stocks_alone, 0.1 * stocks_alone], axis=1))
    np.testing.assert_allclose(flows[:, 0], flows_alone)
    assert (flows[:, 1] <= 0.2 * flows[:, 0] + 1e-12).all() and flows[:, 1].any()
    save_network(tmp_path / "world.png", network, stock, flow, substance=SubstanceAmounts("copper", *parts))


def test_the_command_colours_by_a_substance(tmp_path: Path) -> None:
    """One that is there; another one is told with the nearest."""
    arguments = ["show", EXAMPLE, "--picture", str(tmp_path / "steel.png"), "--substance"]
    plain = CliRunner().invoke(app, [*arguments[:-1]])
    assert "flow of flat_made at least 20 Mt/year" in plain.output and "flat_made at most 0.1 %" in plain.output
    before = (tmp_path / "steel.png").read_bytes()
    result = CliRunner().invoke(app, [*arguments, "copper"])
    assert plain.exit_code == result.exit_code == 0, result.output
    assert (tmp_path / "steel.png").read_bytes() != before
    tin = 'content.tin = { value = 50, unit = "%", source = "s" }'
    scale = '[substances.tin]\nscale = { value = 1, unit = "1", source = "s" }'
    text = Path(EXAMPLE).read_text().replace("[nodes.flat_steel]", f"{scale}\n\n[nodes.flat_steel]")
    path = tmp_path / "two.toml"
    path.write_text(text.replace("[nodes.buildings]", f"{tin}\n\n[nodes.buildings]"))
    pictures = []
    for substance in ("copper", "tin"):
        result = CliRunner().invoke(
            app, ["show", str(path), "--picture", str(tmp_path / "two.png"), "--substance", substance]
        )
        assert result.exit_code == 0, result.output
        pictures.append((tmp_path / "two.png").read_bytes())
    assert pictures[0] != pictures[1]
    wrong = CliRunner().invoke(app, [*arguments, "cooper"])
    assert wrong.exit_code != 0
    assert "unknown substance 'cooper'. Did you mean 'copper'" in str(wrong.exception)


def test_pages_have_contents_and_their_colours() -> None:
    """Of every node and flow in every interval, on one scale for all episodes; without substances there are none."""
    simulations = simulate_alternatives(EXAMPLE, controls=["neutral", "random"], steps=3)
    data = page_data(page_of_alternatives(simulations))
    (network,) = data["networks"]
    (copper,) = network["substances"]
    assert copper["id"] == "copper" and copper["highest"] == pytest.approx(0.004)
    assert [colour for colour, _ in copper["steps"]] == list(STOPS)
    for scene, simulation in zip(data["scenes"], simulations, strict=True):
        (rows,) = scene["contents"]
        np.testing.assert_allclose(np.array(rows).T, simulation.rollout.contents[:, 0], rtol=1e-5)
    plain = page_data(page_of_alternatives(simulate_alternatives("copper_net", controls=["neutral"], steps=2)))
    assert plain["networks"][0]["substances"] == [] and plain["scenes"][0]["contents"] == []
