"""Reports for the browser, without one: places, what is told, and that no text can run. ``test_browser.py`` has one."""

from __future__ import annotations

import base64
import hashlib
import re
from collections import defaultdict
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pages import HOSTILE, bottles_at, shown, world

from cirl_marl import CirlError, Network, indicators, load_network
from cirl_marl.definitions.catalogue import families
from cirl_marl.definitions.sources import stated_numbers
from cirl_marl.drawing.flow_diagram import Box, Ribbon, arrange_boxes, flow_diagrams, groups
from cirl_marl.drawing.layered import NARROW, layered_layout
from cirl_marl.errors import DefinitionError
from cirl_marl.evaluation import compare
from cirl_marl.evaluation.sampling import sample_episodes
from cirl_marl.evaluation.simulations import simulate_alternatives
from cirl_marl.network.elements import Role
from cirl_marl.report import page_html as html_module
from cirl_marl.report.page_data import page_data
from cirl_marl.report.page_html import SCRIPTS, page_html, write_page
from cirl_marl.report.report_page import (
    PLAN,
    USUAL,
    PlanePoint,
    ReportPage,
    add_plan,
    page_of_alternatives,
    page_of_comparison,
    page_of_samples,
)

PARTS = Path(html_module.__file__).parent / "page"


@st.composite
def flows(draw: st.DrawFn) -> tuple[int, list[tuple[int, int]], list[float]]:
    """Draw nodes and flows between them, loops and parallel flows included."""
    count = draw(st.integers(2, 12))
    ends = st.tuples(st.integers(0, count - 1), st.integers(0, count - 1)).filter(lambda pair: pair[0] != pair[1])
    pairs = draw(st.lists(ends, min_size=1, max_size=40))
    return count, pairs, draw(st.lists(st.floats(0, 40), min_size=len(pairs), max_size=len(pairs)))


@given(flows())
def test_nothing_overlaps(drawn: tuple[int, list[tuple[int, int]], list[float]]) -> None:
    """Nodes of a layer and what passes it lie apart; what leads forward passes each layer between, loops go around."""
    count, pairs, given_widths = drawn
    donors, recipients = np.array(pairs, dtype=np.intp).T
    widths, breadths = np.array(given_widths), np.full(count, 30.0)
    found = layered_layout(donors, recipients, widths, breadths, 14.0)
    crossed = defaultdict(list)
    for node in range(count):
        crossed[found.layers[node]].append((found.middles[node], 30.0))
    for (donor, recipient), width, course in zip(pairs, given_widths, found.routes, strict=True):
        low, high = sorted((found.layers[donor], found.layers[recipient]))
        if course.side:
            assert found.layers[donor] >= found.layers[recipient]
            assert not course.via
            assert width / 2 <= course.lane <= found.breadth - width / 2
            within = [node for node in range(count) if low <= found.layers[node] <= high]
            assert all(course.side * (course.lane - found.middles[node]) >= 15 + width / 2 for node in within)
            continue
        assert (found.layers[donor] < found.layers[recipient]) != course.back
        assert len(course.via) == high - low - 1
        for layer, at in zip(range(low + 1, high), course.via, strict=True):
            crossed[layer].append((at, width))
    for items in crossed.values():
        items.sort()
        for (at, size), (next_, more) in pairwise(items):
            assert next_ - at >= (size + more) / 2 + NARROW - 1e-6
    again = layered_layout(donors, recipients, widths, breadths, 14.0)
    assert np.array_equal(again.middles, found.middles) and again.routes == found.routes


def test_the_larger_flow_leads_forward() -> None:
    """Of a cycle the least flow is the loop, and a source stands before all others."""
    found = layered_layout(
        np.array([0, 1, 2, 3]), np.array([1, 2, 3, 1]), np.array([2.0, 9, 9, 3]), np.full(4, 20.0), 10.0
    )
    assert found.layers.tolist() == [0, 1, 2, 3]
    assert [course.side != 0 for course in found.routes] == [False, False, False, True]


def test_a_box_is_as_broad_as_the_most_that_enters_or_leaves() -> None:
    """More leaves ``b`` than enters it."""
    boxes = [Box(label, (place,), Role.TECHNOSPHERE, True) for place, label in enumerate("abc")]
    diagram = arrange_boxes("", boxes, [Ribbon((0,), 0, 1), Ribbon((1,), 1, 2)], np.array([4.0, 5.0]))
    for way, scale in diagram.scales.items():
        np.testing.assert_allclose(diagram.breadths[way] / scale, [4.0, 5.0, 5.0], rtol=1e-12)


@pytest.mark.medium
def test_groups_fold_and_unfold() -> None:
    """A large network whose titles name groups opens on these; inside one, the rest is what it trades with."""
    network = world()
    assert list(groups(network)) == [f"Country {c}" for c in range(4)]
    assert groups(world(countries=3)) == {}, "small"
    assert groups(load_network("steel_japan")) == {}
    whole, *inside = flow_diagrams(network, np.ones(len(network.arcs)))
    assert [box.label for box in whole.boxes] == ["World market", "World store", *groups(network)]
    assert sum(len(ribbon.members) for ribbon in whole.ribbons) == 3 * 4 + 1, "what stays in a country is not drawn"
    assert {box.opens for box in whole.boxes} == {"", *groups(network)}
    weave = whole.layouts["lying"]
    assert weave.layers.tolist() == [1, 1, 2, 2, 2, 2], "the markets stand beside who takes more than he gives"
    assert [course.back for course in weave.routes] == [weave.layers[each.donor] == 2 for each in whole.ribbons]
    assert [course.side != 0 for course in weave.routes] == [each.members == (0,) for each in whole.ribbons]
    assert [each.group for each in inside] == list(groups(network))
    assert {box.label for box in inside[1].boxes} == {"World market", "World store", *(f"part {i}" for i in range(16))}
    assert all("c1_" in network.arcs[k].id for ribbon in inside[1].ribbons for k in ribbon.members)
    object.__setattr__(network, "copies", {"north_sea": ["c0_0", "c0_1"], "south": ["c1_0", "c1_1"]})
    assert groups(network) == {"North Sea": [2, 3], "South": [18, 19]}


@pytest.mark.medium
@pytest.mark.sample(2)
@pytest.mark.parametrize("name", [names[0] for names in families().values()])
def test_every_number_has_its_source(name: str) -> None:
    """What is told of compartments is what their definition states, under the scenario."""
    network = load_network(name)
    told = stated_numbers(network)
    assert set(told["nodes"]) == {node.id for node in network.nodes}
    assert set(told["arcs"]) == {arc.id for arc in network.arcs}
    assert all(each.source for table in told.values() for found in table.values() for each in found)


def test_sources_follow_scenario_and_file(tmp_path: Path) -> None:
    """A scenario's number has the scenario's source; a file that was changed since tells nothing of this network."""
    network = bottles_at(tmp_path)
    (initial,) = (each for each in stated_numbers(network)["nodes"]["quarry"] if each.key == "initial")
    assert (initial.value, initial.source) == ("10000 – 10000 t", "survey")
    crisis = {each.key: each.source for each in stated_numbers(network.scenario("crisis"))["nodes"]["quarry"]}
    assert crisis["initial"] == "assumed" and crisis["control"] == "quarrying from none to +20 %"
    assert set(stated_numbers(replace(network, source=None))) == {"nodes", "arcs", "services"}
    (tmp_path / "bottles.toml").write_text("name = 'other'")
    with pytest.raises(DefinitionError, match="has changed since it was read"):
        stated_numbers(network)


def test_the_page_shows_what_was_simulated(tmp_path: Path) -> None:
    """Stocks, flows, λ, service and controls are those of the CSV file, to six digits; start and units included."""
    (found,) = simulate_alternatives(bottles_at(tmp_path))
    told = page_data(page_of_alternatives([found]))
    header, rows = found.table()
    columns = dict(zip(header, zip(*rows, strict=True), strict=True))
    (scene,), (network,) = told["scenes"], told["networks"]
    for node, values in zip(network["nodes"], scene["levels"], strict=True):
        np.testing.assert_allclose(values, columns[f"stock of {node['id']} (t)"], rtol=1e-5)
    for arc, values in zip(network["arcs"], scene["flows"], strict=True):
        np.testing.assert_allclose(values, columns[f"flow of {arc['id']} (t/day)"][1:], rtol=1e-5)
    np.testing.assert_allclose(scene["lambda"]["value"], columns["mean circularity (t)"][1:], rtol=1e-5)
    np.testing.assert_allclose(scene["services"][0]["value"], columns["service level"][1:], rtol=1e-5)
    assert [each["agent"] for each in network["settings"]] == list(found.network.agents)
    assert all(set(scene["controls"][each["row"]]) == {1} for each in network["settings"])
    assert told["clock"]["labels"][-1] == "day 12" and (told["mass"], told["time"]) == ("t", "day")
    assert [arc["sign"] for arc in network["arcs"]] == [-1, -1]


@pytest.mark.medium
def test_the_page_of_a_comparison(tmp_path: Path) -> None:
    """Business as usual comes first; bands are intervals over episodes, flows those of the first; the plan is best."""
    found = compare([], ["random", "neutral"], network=bottles_at(tmp_path, days=4), episodes=3)
    story = page_of_comparison(found)
    assert [scene.name for scene in story.episodes] == [USUAL, "random"]
    usual, random = story.episodes
    entry = next(each for each in found.entries if each.name == "random")
    (band,) = random.bands["circularity"]
    assert band.low is not None and (band.low < band.value).any()
    np.testing.assert_allclose(band.value, entry.rollout.circularity_mean.mean(axis=0))
    np.testing.assert_array_equal(random.rollout.flow, entry.rollout.flow)
    assert np.isfinite(usual.rollout.start).all()
    moved = entry.rollout.flow[0] @ np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]])
    np.testing.assert_allclose(
        usual.rollout.start + moved, entry.rollout.stock[0], rtol=1e-9, err_msg="the first start"
    )
    assert random.figures["gap"] == found.rows[0].figure("gap") and len(story.front)
    env = next(each.env for each in simulate_alternatives(found.network))
    best = add_plan(page_of_comparison(found, without=["random"]), found, env)
    assert [scene.name for scene in best.episodes] == [USUAL, PLAN]
    assert found.entries[0].bound is not None
    planned, bound = float(best.episodes[-1].bands["circularity"][0].value.mean()), float(found.entries[0].bound[0])
    assert float(entry.circularity[0]) < planned <= bound + 1e-9
    told = page_data(best)
    assert [scene["plan"] for scene in told["scenes"]] == [False, True]
    mean = found.rows[1].figure("bound")
    assert mean is not None and told["scenes"][0]["figures"]["bound"][0] == pytest.approx(mean.value, rel=1e-5)


@pytest.mark.medium
def test_the_page_of_samples(tmp_path: Path) -> None:
    """Bands are quantiles; the start is not known, and says so by nothing."""
    path = tmp_path / "bottles.toml"
    bottles_at(tmp_path)
    path.write_text(path.read_text().replace("rate = { value = 0.05,", 'rate = { value = 0.05, deviation = "9 %",'))
    found = sample_episodes(load_network(path), samples=5)
    scene, *single = page_data(page_of_samples(found, "neutral"))["scenes"]
    for i, draw in enumerate(single):
        np.testing.assert_allclose(draw["lambda"]["value"], found.rollout.circularity_mean[i], rtol=1e-5)
        np.testing.assert_allclose(np.array(draw["flows"]).T, found.rollout.flow[i], rtol=1e-5)
    assert len(single) == 3
    assert {values[0] for values in scene["levels"]} == {None}
    np.testing.assert_allclose(
        scene["lambda"]["high"], np.quantile(found.rollout.circularity_mean, 0.975, axis=0), rtol=1e-5
    )
    assert scene["controls"] is None and "5 samples" in scene["about"]


def test_no_text_can_run(tmp_path: Path) -> None:
    """Hostile titles and sources stand in the data as they are, nowhere as markup; hashes allow the script alone."""
    network = bottles_at(tmp_path, hostile=True)
    text = page_html(page_of_alternatives(simulate_alternatives(network)))
    told = shown(text)
    assert told["title"] == HOSTILE == told["networks"][0]["arcs"][0]["label"]
    assert HOSTILE in {source for *_, source in told["networks"][0]["arcs"][0]["told"]}
    assert text.count("<script") == text.count("</script>") == 2 and "<img" not in text
    assert "\u2028" not in text.split("</title>")[1], "it ends a line of a script"
    ((script,), (style,)) = (
        re.findall(pattern, text, re.DOTALL) for pattern in (r"module\">(.*?)</script>", r"<style>(.*?)</style>")
    )
    for part in (script, style):
        assert f"'sha256-{base64.b64encode(hashlib.sha256(part.encode()).digest()).decode()}'" in text
    assert "default-src 'none'" in text and "unsafe" not in text


def test_the_script_has_no_way_out() -> None:
    """Modules import from those before them, each is part of the page, and none parses markup or asks the network."""
    assert {path.stem for path in PARTS.glob("*.js")} == set(SCRIPTS)
    for i, name in enumerate(SCRIPTS):
        text = (PARTS / f"{name}.js").read_text(encoding="utf-8")
        imports = re.findall(r"^import \{ ([\w, ]+) \} from \"\./(\w+)\.js\";$", text, re.M)
        assert len(imports) == len(re.findall(r"\bimport\b", text))
        for names, source in imports:
            assert source in SCRIPTS[:i]
            known = re.findall(r"^export (?:function|const) (\w+)", (PARTS / f"{source}.js").read_text(), re.M)
            assert set(names.split(", ")) <= set(known)
        assert not re.search(
            r"innerHTML|outerHTML|insertAdjacent|document\.write|eval\(|fetch|XMLHttp|http:",
            text.replace("http://www.w3.org/2000/svg", ""),
        )
    assert not re.search(r"https?:|@import|url\(", (PARTS / "page.css").read_text())


def test_a_page_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What cannot be written, or shown, leaves the page that was there."""
    network = bottles_at(tmp_path, days=2)
    story = page_of_alternatives(simulate_alternatives(network))
    path = write_page(tmp_path / "new" / "page.html", story)
    before = path.read_text(encoding="utf-8")
    with pytest.raises(CirlError, match="network 'bottles': there is nothing to show, neither episodes nor points"):
        write_page(path, ReportPage("nothing", network))
    (other,) = page_of_alternatives(simulate_alternatives(network, steps=3)).episodes
    with pytest.raises(CirlError, match=r"2 intervals of 1 day, '.*' 3 of 1: a page shows them by one clock"):
        write_page(path, replace(story, episodes=(*story.episodes, other)))

    def full(self: Path, *_: object) -> None:
        with self.open("w") as file:
            file.write("half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="No space left"):
        write_page(path, story)
    assert path.read_text(encoding="utf-8") == before
    assert list(path.parent.iterdir()) == [path]


def test_points_alone_are_a_page(tmp_path: Path) -> None:
    """A sweep has no episodes: what is there are its points and the bound."""
    network: Network = bottles_at(tmp_path)
    points = (PlanePoint("plans", 0.9, -2.0), PlanePoint("plans", float("nan"), -3.0))
    told = page_data(ReportPage("sweep", network, points=points, front=np.array([[0.9, -1.0], [1.0, -1.5]])))
    assert told["scenes"] == told["networks"] == [] and told["front"] == [[0.9, -1], [1, -1.5]]
    assert [each["service"] for each in told["points"]] == [0.9, None]


def test_indicators_stand_among_the_figures() -> None:
    """Of every scene, as shares without an interval; a network in which nothing is in use has none."""
    for name in ("copper_net", "carbo_net"):
        simulations = simulate_alternatives(name, steps=20)
        (simulation,) = simulations
        found = indicators(simulation.network, simulation.rollout.mean_flow)
        told = page_data(page_of_alternatives(simulations))["scenes"][0]["figures"]
        if found is None:
            assert name == "carbo_net" and not {"recycling_rate", "recycled_content"} & told.keys()
            continue
        expected = {"recycling_rate": found.recycling_rate, "recycled_content": found.recycled_content}
        for which, share in expected.items():
            assert told[which] == [pytest.approx(share, rel=1e-4), None, None]
