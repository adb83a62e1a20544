"""Rules of feedback: what a definition says comes out, in every copy, and what cannot be a rule is refused."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cirl_marl import MultiAgentVectorEnv, Network, NetworkError, load_network, write_network
from cirl_marl.controllers import ScriptController
from cirl_marl.definitions.catalogue import folder
from cirl_marl.network.elements import FeedbackRule
from cirl_marl.network.processes import interval_of


def with_rule(rule: FeedbackRule, agent: str = "virgin_fibre") -> Network:
    """Return paper_city, which is disturbed, where one agent alone has a rule."""
    network = load_network("paper_city").scenario("breakdowns")
    arcs = tuple(replace(arc, rule=rule if arc.id == agent else None) for arc in network.arcs)
    return replace(network, arcs=arcs, scenarios={})


def test_a_rule_is_its_formula() -> None:
    """u₀·Π ξ·(1 + Σ g·(1 − q/aim)) within the bounds, from stocks and services at the start of the interval."""
    watches = ("bales", "paper_delivered")
    rule = FeedbackRule(level=0.5, follows=("orders", "line_runs"), watches=watches, gains=(0.3, -0.2))
    env = MultiAgentVectorEnv(with_rule(rule), num_envs=5)
    controller, observations = ScriptController(), env.reset(seed=7)
    controller.start(env, 0)
    bales, place = env.network.node_index["bales"], env.network.arc_index["paper"]
    names, row = env.network.processes.names, env.network.control_rows["virgin_fibre"].start
    seen = set[bool]()
    for _ in range(20):
        state = env.physical
        orders, runs = (interval_of(state.disturbances, state.step)[names.index(n)] for n in ("orders", "line_runs"))
        lack = 1 - state.flow[place] / (70 * orders)
        expected = 90 * orders * runs * (1 + 0.3 * (1 - state.stock[bales] / 60) - 0.2 * lack)
        observations = env.by_agent(env.advance(env.stack(controller.act(observations))).observation)
        np.testing.assert_allclose(env.controls[row], np.clip(expected, 0, 120), rtol=1e-6)
        seen |= set((runs > 0).tolist())
    assert seen == {True, False}


def test_without_terms_a_rule_is_neutral_and_held_agents_do_not_listen() -> None:
    """An empty rule is neutral control; a constant given beside the script wins."""
    env = MultiAgentVectorEnv(with_rule(FeedbackRule(follows=("orders",))), num_envs=2)
    observations, controller = env.reset(seed=1), ScriptController({"virgin_fibre": 0.25})
    controller.start(env, 0)
    assert controller.act(observations)["virgin_fibre"].tolist() == [[0.25], [0.25]]
    env = MultiAgentVectorEnv(with_rule(FeedbackRule()), num_envs=2)
    observations, controller = env.reset(seed=1), ScriptController()
    controller.start(env, 0)
    np.testing.assert_array_equal(
        controller.act(observations)["virgin_fibre"], env.neutral_action["virgin_fibre"].astype(float)
    )


def test_a_rule_survives_the_file(tmp_path: Path) -> None:
    """What is written is read again."""
    network = with_rule(FeedbackRule(level=-0.5, follows=("orders",), watches=("bales",), gains=(2.0,)))
    write_network(network, path := tmp_path / "paper_city.toml")
    assert load_network(path).compartments["virgin_fibre"].rule == network.compartments["virgin_fibre"].rule


@pytest.mark.parametrize(
    ("rule", "fault"),
    [
        (
            FeedbackRule(follows=("order",)),
            "follows: unknown disturbance that disturbs something 'order'. Did you mean 'orders'",
        ),
        (FeedbackRule(watches=("bale",), gains=(1.0,)), "watches: unknown aim 'bale'. Did you mean 'bales'"),
        (FeedbackRule(watches=("forest",), gains=(1.0,)), "watches: unknown aim 'forest'"),
        (FeedbackRule(watches=("bales",)), "needs a gain for each of what it watches, got 0 for 1"),
        (FeedbackRule(level=2.0), "level 2.0 must lie in"),
    ],
)
def test_what_a_rule_cannot_be(rule: FeedbackRule, fault: str) -> None:
    """Names that nothing has, aims that there are not, and gains for nothing are refused."""
    with pytest.raises(NetworkError, match=fault.replace("(", r"\(")):
        with_rule(rule)
    if not rule.follows:
        with pytest.raises(NetworkError, match="rule: needs a control"):
            with_rule(FeedbackRule(), "collection")


def test_rules_of_copies_name_what_stands_in_the_copy(tmp_path: Path) -> None:
    """What a rule watches in a copied definition is, in each copy, that of the copy."""
    text = (folder("envs") / "paper_city.toml").read_text(encoding="utf-8")
    head = text.split("[nodes.forest]", 1)[0]
    rule = '\n[arcs.feed.rule]\nwatches = ["hall"]\ngains = [-1]\n'
    city = text.split("# Breakdowns", 1)[0] + rule + '[regions]\nnorth = "North"\nsouth = "South"\n'
    (tmp_path / "city.toml").write_text(city, encoding="utf-8")
    both = re.sub(r"agents = .*\n", "", head).replace('"paper_city"', '"cities"')
    (tmp_path / "cities.toml").write_text(both + '[nodes]\n[arcs]\n[copies]\nof = "city.toml"\n', encoding="utf-8")
    network = load_network(tmp_path / "cities.toml")
    rules = {id_: part.rule for id_, part in network.compartments.items() if part.rule is not None}
    assert {id_: found.watches for id_, found in rules.items()} == {
        "north_feed": ("north_hall",),
        "south_feed": ("south_hall",),
    }
