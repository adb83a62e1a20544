"""Copies of a definition with regions, side by side in one network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from series_definition import SOURCE, column, definition, written

from cirl_marl import CirlError, DefinitionError, MultiAgentVectorEnv, Network, RecipeError, load_network
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import rollout
from cirl_marl.definitions.reader import Definition, write_network
from cirl_marl.drawing.digraph import save_network
from cirl_marl.drawing.folding import fold_copies
from cirl_marl.learners.recipe import Recipe

ONE = f'unit = "1", {SOURCE}'
REGIONS = '[regions]\njapan = "Japan"\nchina = "China"\n'
SERVICE = f"""
[services.in_use]
title = "ore in use"
provider = "use"
quantity = "stock"
low = {{ value = 1, unit = "kt", {SOURCE} }}
weight = {{ value = 1, {ONE} }}
"""
SCENARIOS = f"""
[scenarios.more]
without = ["services.in_use"]

[scenarios.more.arcs.ore]
flow = {{ value = 8, unit = "kt/year", {SOURCE} }}
"""
COPIED = definition(column('where = { country = "{region}" }'), start="2000", more=REGIONS + SERVICE + SCENARIOS)
COPIES = '[copies]\nof = "ores.toml"\n'
CHANGED = '[copies.arcs.lost]\nto = "port"\n'
PORT = f"""
[nodes.port]
role = "technosphere"
stores = false

[nodes.sea]
role = "landfill"
initial = {{ low = 0, high = 0, unit = "kt", {SOURCE} }}

[arcs.landed]
from = "port"
to = "china_market"
law = "share"
share = {{ value = 0.25, {ONE} }}

[arcs.sunk]
from = "port"
to = "sea"
law = "share"
share = "rest"
"""
MORE = "[scenarios.more]\n"
TEXT = COPIED.partition("[nodes.mine]")[0].replace('"ores"', '"trade"') + COPIES + CHANGED + PORT + MORE


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with the definition that is copied."""
    written(tmp_path, COPIED)
    return tmp_path


def network(folder: Path, text: str = TEXT, scenario: str | None = None) -> Network:
    """Return the network of a definition beside it."""
    (folder / "trade.toml").write_text(text, encoding="utf-8")
    return load_network(folder / "trade.toml", scenario=scenario)


def test_a_copy_stands_for_each_region(folder: Path) -> None:
    """With names that begin with it, numbers of its own, and ends where the others are, or are common."""
    found = network(folder)
    assert found.name == "trade" and found.region == ""
    assert [arc.id for arc in found.arcs if arc.donor == "china_market"] == ["china_sold", "china_lost"]
    assert {arc.recipient for arc in found.arcs if arc.id.endswith("_lost")} == {"port"}
    assert [(each.id, each.provider, each.title) for each in found.services] == [
        ("japan_in_use", "japan_use", "Japan: ore in use"),
        ("china_in_use", "china_use", "China: ore in use"),
    ]
    assert "dump" not in found.node_index and "japan_dump" in found.node_index
    run = rollout(MultiAgentVectorEnv(found, num_envs=1), Neutral())
    flow = {arc.id: run.flow[:, k] for k, arc in enumerate(found.arcs)}
    np.testing.assert_allclose(flow["japan_ore"], [10, 20, 30, 40])
    np.testing.assert_allclose(flow["china_ore"], [1, 1, 3, 3])
    np.testing.assert_allclose(flow["landed"], flow["china_sold"] * 2 - flow["china_ore"])
    np.testing.assert_allclose(flow["landed"], (flow["japan_lost"] + flow["china_lost"]) / 4)


def test_a_copy_is_limited_by_its_own_plant(folder: Path) -> None:
    """What limits an arc of the file is the copy of it in each region."""
    range_ = f'kind = "flow", low = 0, neutral = 1, high = 2, unit = "kt/year", {SOURCE}'
    limited = f"""
[arcs.returned]
from = "dump"
to = "use"
law = "controlled"
capacity_node = "use"
capacity_rate = {{ value = 0.5, unit = "1/year", {SOURCE} }}
control = {{ {range_} }}
"""
    written(folder, COPIED + limited)
    found = {arc.id: arc.capacity_node for arc in network(folder).arcs if arc.capacity_node}
    assert found == {"japan_returned": "japan_use", "china_returned": "china_use"}


def test_a_scenario_is_that_of_the_copies_too(folder: Path) -> None:
    """Then what it says of the copies here, then its own tables, of copies and of what joins them."""
    found = network(folder, scenario="more")
    assert not found.services and [arc.flow for arc in found.arcs if arc.id.endswith("_ore")] == [8.0, 8.0]
    half = f"[scenarios.more.copies.arcs.sold]\nshare = {{ value = 0.2, {ONE} }}\n"
    one = f"[scenarios.more.arcs.japan_sold]\nshare = {{ value = 0.1, {ONE} }}\n"
    found = network(folder, TEXT + half + one, "more")
    assert [arc.share for arc in found.arcs if arc.id.endswith("_sold")] == [0.1, 0.2]
    assert [arc.share for arc in network(folder, TEXT + half + one).arcs if arc.id.endswith("_sold")] == [0.5, 0.5]


def test_what_is_in_copies_is_said_by_who_copies_them(folder: Path) -> None:
    """Contents are those of each region; of a substance, or an account, that both files have, the own one holds."""
    part = f'content.iron = {{ file = "content.csv", column = "iron", where = {{ country = "{{region}}" }}, {ONE} }}\n'
    iron, own = (f"[substances.iron]\nscale = {{ value = {scale}, {ONE} }}\n" for scale in (0.2, 0.5))
    cost, dollars = (f'[accounts.cost]\nunit = "{unit}"\n' for unit in ("EUR_2020", "USD_2020"))
    written(folder, COPIED.replace("[nodes.mine]", f"{iron}{cost}[nodes.mine]\n{part}"))
    (folder / "content.csv").write_text("country,iron\nJapan,0.3\nChina,0.6\n", encoding="utf-8")
    found = network(folder, TEXT.replace("[nodes.port]", own + dollars + "[nodes.port]"))
    assert [(part.id, part.scale) for part in found.substances] == [("iron", 0.5)]
    assert [account.unit for account in found.accounts] == ["USD_2020"]
    contents = {node.id: dict(node.content) for node in found.nodes if node.content}
    assert contents == {"japan_mine": {"iron": 0.3}, "china_mine": {"iron": 0.6}}


def test_some_regions_and_less_of_each(folder: Path) -> None:
    """What is left out of the copies need not be left out again by their scenarios."""
    text = TEXT.replace(COPIES, COPIES + 'regions = ["china"]\nwithout = ["services.in_use", "nodes.dump"]\n')
    for scenario in (None, "more"):
        found = network(folder, text, scenario)
        assert {node.id for node in found.nodes} == {"china_mine", "china_market", "china_use", "port", "sea"}
        assert not found.services


def test_scales_are_those_of_the_copied_file(folder: Path) -> None:
    """Each compartment has that of its region, unless it states one."""
    scale = (
        f'stock = {{ file = "ores.csv", column = "kt", where = {{ country = "{{region}}", year = "2002" }}, {ONE} }}'
    )
    stock = next(line for line in COPIED.splitlines() if line.startswith("stock = "))
    written(folder, COPIED.replace(stock, scale.replace('unit = "1"', 'unit = "kt"')))
    found = network(folder)
    assert [found.compartments[each].scale for each in ("japan_use", "china_use", "sea")] == [30.0, 3.0, 1.0]


def test_it_is_read_again(folder: Path) -> None:
    """After it was written out in full, and when the copied file is edited, whose hash is kept."""
    found = network(folder)
    assert set(found.data_sha256) == {"ores.toml", "ores.csv"}
    write_network(found, folder / "full.toml")
    assert load_network(folder / "full.toml") == found
    (folder / "ores.toml").write_text(COPIED.replace("value = 0.5", "value = 0.25"), encoding="utf-8")
    again = load_network(folder / "trade.toml")
    assert again.arcs[again.arc_index["japan_sold"]].share == 0.25


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('of = "ores.toml"', 'of = "ore.toml"', "copies.of: file 'ore.toml': is not there; unknown file"),
        ('of = "ores.toml"', 'of = "../ores.toml"', "copies.of: file '../ores.toml': must lie in"),
        ('of = "ores.toml"', 'off = "ores.toml"', "copies.off: unknown key 'off'. Did you mean 'of'?"),
        ('of = "ores.toml"', 'of = "trade.toml"', "copies.of: 'trade.toml' has copies itself"),
        (COPIES, COPIES + 'regions = ["jpan"]\n', "copies.regions: unknown region 'jpan'. Did you mean 'japan'?"),
        (COPIES, COPIES + 'without = ["nodes.dmp"]\n', "copies.without: 'nodes.dmp': unknown key 'dmp'. Did you mean"),
        (CHANGED, CHANGED.replace("lost", "los"), "copies.arcs: unknown arc 'los'. Did you mean 'lost'?"),
        ('to = "port"', 'to = "prt"', "arc 'japan_lost'"),
        ("[nodes.sea]", "[nodes.japan_use]", "nodes.japan_use: a copy of 'ores.toml' has the same name"),
        (MORE, '[scenarios.more.copies]\nof = "ores.toml"\n', "scenarios.more.copies.of: a scenario cannot set it"),
        (
            MORE,
            '[scenarios.more.copies.arcs.sld]\nto = "port"\n',
            "scenarios.more.copies.arcs: unknown arc 'sld'. Did you mean 'sold'?",
        ),
    ],
)
def test_mistakes_are_named(folder: Path, old: str, new: str, said: str) -> None:
    """By the keys of the file in which they are."""
    assert old in TEXT
    (folder / "trade.toml").write_text(TEXT.replace(old, new), encoding="utf-8")
    with pytest.raises(DefinitionError) as refused:
        Definition(folder / "trade.toml").check()
    assert said in str(refused.value) and str(refused.value).startswith(str(folder / "trade.toml"))


def test_a_copy_is_of_a_region(folder: Path) -> None:
    """A definition without regions is not copied."""
    (folder / "ores.toml").write_text(definition(), encoding="utf-8")
    with pytest.raises(
        DefinitionError, match=r"copies\.of: 'ores\.toml' has no \[regions\], and a copy is of a region"
    ):
        network(folder)


def test_copies_are_folded_in_pictures(folder: Path) -> None:
    """Each is a box; what it takes and loses are boxes of all; stocks and flows add up; one may be shown as it is."""
    found = network(folder)
    run = rollout(MultiAgentVectorEnv(found, num_envs=1), Neutral())
    stock, flow = run.stock[-1], run.flow[-1]
    seen, held, moved = fold_copies(found, stock, flow)
    assert {node.id for node in seen.nodes} == {
        "japan",
        "china",
        "all_nonrenewable_reservoir",
        "between",
        "sea",
        "all_landfill",
    }
    at = {node.id: i for i, node in enumerate(seen.stores)}
    assert held.sum() == pytest.approx(stock.sum())
    assert held[at["japan"]] == pytest.approx(stock[found.node_index["japan_use"]])
    arrows = {(arc.donor, arc.recipient): value for arc, value in zip(seen.arcs, moved.tolist(), strict=True)}
    lost = {arc.id: float(flow[k]) for k, arc in enumerate(found.arcs)}
    assert arrows["japan", "between"] == pytest.approx(lost["japan_lost"]) and len(arrows) == 6
    assert float(seen.circularity(moved)) == pytest.approx(float(found.circularity(flow)))
    open_, _, _ = fold_copies(found, stock, flow, ["japan"])
    shown = {arc.id for arc in open_.arcs}
    assert {"japan_sold", "japan_ore", "china_to_between"} <= shown and "china_sold" not in shown
    save_network(folder / "seen.png", found, stock, flow, open_copies=["japan"])
    assert (folder / "seen.png").stat().st_size > 1000
    with pytest.raises(CirlError, match=r"unknown copy to unfold 'jpan'\. Did you mean 'japan'\?"):
        fold_copies(found, stock, flow, ["jpan"])
    plain = load_network("copper_net")
    assert fold_copies(plain, stock, flow)[0] is plain


def recipe(scheme: str) -> Recipe:
    """Return one whose learners are for the same agent in all copies."""
    learner = {"algorithm": "ARS", "scheme": scheme, "among": "copies"}
    return Recipe.model_validate({"name": "mine", "title": "copies learn together", "learner": learner})


def test_the_same_agents_of_all_copies_share_a_policy(folder: Path) -> None:
    """Named by what they are copies of; what is of no copy learns by itself, also if it ends at one."""
    found = network(folder)
    agents = ["japan_ore", "china_ore", "china_market", "japan_market", "landed", "port"]
    groups = {group.name: group.agents for group in recipe("shared").groups(found, agents)}
    assert groups == {
        "shared-learner-ore": ("japan_ore", "china_ore"),
        "shared-learner-market": ("china_market", "japan_market"),
        "shared-learner-landed": ("landed",),
        "shared-learner-port": ("port",),
    }
    sunk = next(arc for arc in found.arcs if arc.id == "sunk")
    named = replace(found, arcs=(*(arc for arc in found.arcs if arc is not sunk), replace(sunk, id="china_sunk")))
    assert named.counterpart("china_sunk") is None and named.counterpart("china_ore") == "ore"
    with pytest.raises(RecipeError, match="among: copies, but network 'ores' is not made of copies"):
        recipe("joint").groups(load_network(written(folder, definition())), ["mine"])
    with pytest.raises(RecipeError, match="among: copies is for the schemes shared and joint"):
        recipe("independent").check(100)


def test_each_copy_is_disturbed_by_itself(folder: Path) -> None:
    """Or all by what is common; what correlates them follows from the matrix and what regions have in common."""
    process = f'kind = "ar1"\ndeviation = 0.2\npersistence = 0.5\nlow = 0.5\nhigh = 1.5\nunit = "1"\n{SOURCE}\n'
    parts = f"""
[disturbances.demand]
{process}observed_by = ["market", "use"]

[disturbances.weather]
{process}common = true

[disturbance_correlation]
names = ["demand", "weather"]
matrix = [[1.0, 0.4], [0.4, 1.0]]
regions = {{ value = 0.5, {ONE} }}
{SOURCE}
"""
    written(folder, COPIED + parts)
    plain = network(folder)
    assert not plain.disturbed and not plain.processes.names
    wet = TEXT + '[copies.services.in_use]\nlow.disturbed_by = "weather"\n'
    shaken = wet + '[scenarios.more.copies.arcs.ore]\nflow.disturbed_by = "demand"\n'
    assert {path: effect.by for path, effect in network(folder, wet).disturbed.items()} == {
        "services.japan_in_use.low": "weather",
        "services.china_in_use.low": "weather",
    }
    found = network(folder, shaken, "more")
    assert {path: effect.by for path, effect in found.disturbed.items()} == {
        "arcs.japan_ore.flow": "japan_demand",
        "arcs.china_ore.flow": "china_demand",
    }
    assert found.disturbances["china_demand"].observed_by == ("china_market", "china_use")
    assert found.correlation.names == ("japan_demand", "china_demand", "weather")
    assert found.correlation.matrix == ((1.0, 0.5, 0.4), (0.5, 1.0, 0.4), (0.4, 0.4, 1.0))
    write_network(found, folder / "whole.toml")
    again = load_network(folder / "whole.toml")
    assert (again.disturbances, again.disturbed) == (found.disturbances, found.disturbed)
    written(folder, COPIED + parts.replace("[0.4, 1.0]]", "[0.4, 1.0], [0.0, 0.0]]"))
    with pytest.raises(DefinitionError, match="disturbance_correlation: needs a matrix of 2 rows of 2 numbers"):
        network(folder, shaken, "more")
    written(folder, COPIED + parts.replace("matrix", "matrx"))
    with pytest.raises(DefinitionError, match=r"disturbance_correlation.matrx: .*Did you mean 'matrix'"):
        network(folder, shaken, "more")
