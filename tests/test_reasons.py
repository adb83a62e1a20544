"""What agents look at and the rules that act like them: against closed forms, and policies of every kind."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pages import shown

import cirl_marl
from cirl_marl import CirlError, MultiAgentVectorEnv, Network, RunError, load_network
from cirl_marl.controllers.basic import Arrays
from cirl_marl.controllers.rollout import first_seed, rollout
from cirl_marl.evaluation.assessment import evaluate
from cirl_marl.learners.interface import Trained, train
from cirl_marl.learners.policies import DifferentiablePolicy, Policies, Policy
from cirl_marl.learners.recipe import LearnerSettings, Normalisation, Recipe, Run
from cirl_marl.learners.views import OneAgent
from cirl_marl.reasons.attribution import _memories, attribute_inputs
from cirl_marl.reasons.explanation import explain
from cirl_marl.reasons.input_signals import policy_columns, signal_of
from cirl_marl.reasons.interventions import Recorder
from cirl_marl.reasons.rules import distil_rules
from cirl_marl.reasons.sentences import input_sentence, rule_sentences
from cirl_marl.report.explanations import read_reasons, write_reasons
from cirl_marl.report.page_html import page_html
from cirl_marl.report.report_page import page_of_evaluation

Floats = NDArray[np.floating]
FIRST = first_seed(0)


class Known(Policies):
    """Agents that do what functions of their observations say, which can be differentiated."""

    def __init__(self, env: MultiAgentVectorEnv, does: dict[str, Callable[[torch.Tensor], torch.Tensor]]) -> None:
        """Let each agent of ``env`` act by its function, the others do nothing."""
        policies = {}
        for agent in env.agents:
            act = does.get(agent, lambda seen: seen[:, :1] * 0)
            policy = SimpleNamespace(
                _predict=lambda seen, deterministic, act=act: act(seen), set_training_mode=lambda mode: None
            )
            policies[agent] = Policy(cast(Any, SimpleNamespace(policy=policy)), None, OneAgent(env, agent))
        super().__init__(policies)

    def act(self, observations: Arrays) -> Arrays:
        """Return the clipped actions."""
        return {
            agent: np.clip(DifferentiablePolicy(policy)(torch.as_tensor(observations[agent])).numpy(), -1.0, 1.0)
            for agent, policy in self.policies.items()
        }


def copper(copies: int = 4, horizon: int = 12) -> MultiAgentVectorEnv:
    """Return a few copies of a short copper_net with two agents."""
    agents = ["use_to_collection", "mine_to_refinery"]
    return MultiAgentVectorEnv("copper_net", num_envs=copies, horizon=horizon, agents=agents)


def test_a_linear_policy_is_attributed_exactly() -> None:
    """IG_i = w_i (x_i − mean): shares and slopes follow, and hiding what has no weight changes nothing."""
    env = copper()
    size = len(env.observation_names["use_to_collection"])
    weights = np.zeros(size)
    weights[[0, 1, size - 1]] = 0.05, -0.2, 0.4
    known = {"use_to_collection": lambda seen: (seen @ torch.as_tensor(weights, dtype=seen.dtype))[:, None]}
    policies, watching = Known(env, known), None
    watching = Recorder(policies)
    usual = rollout(env, watching, seed=FIRST)
    found, other = attribute_inputs(env, policies, policies, watching.episodes, usual, FIRST, top=3)
    seen = watching.episodes.observations["use_to_collection"].reshape(-1, size)
    sizes = np.abs(weights * (seen - seen.mean(axis=0))).mean(axis=0)
    order = np.argsort(-sizes)
    names = env.observation_names["use_to_collection"]
    assert [each.name for each in found.signals[:3]] == [names[i] for i in order[:3]]
    np.testing.assert_allclose(found.share, sizes[order] / sizes.sum(), atol=1e-5)
    np.testing.assert_allclose(found.slope[0, :3], weights[order[:3]], rtol=1e-4)
    assert found.residual < 1e-4
    assert found.least_held is not None and found.least_held.circularity.value == 0.0
    assert abs(found.top_held.circularity.value) > 1e-6
    assert "looks at" in input_sentence(env.network, found) and "acts more as it rises" in input_sentence(
        env.network, found
    )
    assert not other.share.any() and "always does the same" in input_sentence(env.network, other)


def dated(network: Network) -> Network:
    """Return the network on the calendar, with yearly decisions."""
    episode = replace(network.episode, start=2026.0, control_interval=1.0, horizon=12)
    objective = replace(network.objective, reference_interval=1.0)
    return replace(network, episode=episode, objective=objective, time_unit="year", scenarios={})


def test_a_rule_is_found_again() -> None:
    """From 2031 on, while a stock is above a number, and not else: the tree says so, in years and in mass."""
    network = dated(load_network("copper_net"))
    env = MultiAgentVectorEnv(network, num_envs=32, agents=["use_to_collection", "mine_to_refinery"])
    names = env.observation_names["use_to_collection"]
    time, stock = names.index("time"), names.index("stock of use")
    scale = network.compartments["use"].scale
    limit = 200.0 / scale

    def opens(seen: torch.Tensor) -> torch.Tensor:
        late, full = seen[:, time] > 4.5 / 12, seen[:, stock] > limit
        return torch.where(late & full, 1.0, -1.0)[:, None]

    policies = Known(env, {"use_to_collection": opens})
    usual = rollout(env, policies, seed=FIRST)
    found = distil_rules(env, policies, usual, FIRST, leaves=4)
    rule, idle = found.rules
    assert rule.explained_variance > 0.99 and idle.explained_variance == 1.0
    said = rule_sentences(network, rule)
    opened = next(each for each in said if "opens" in each)
    assert opened.startswith("From 2031 on, while stock of Copper in use is above 2") or opened.startswith(
        "From 2031 on, while stock of Copper in use is above 1"
    )
    leaf = max(rule.leaves, key=lambda leaf: leaf.action[0])
    (above,) = [each for each in leaf.conditions if each.signal.name == "stock of use"]
    assert above.low * scale == pytest.approx(200.0, rel=0.1) and above.signal.unit == network.mass_unit
    low, _, high = network.control_bounds[:, network.control_rows["use_to_collection"].start, 0]
    assert leaf.control[0] == pytest.approx(high) and low < high
    # it loses what it gets wrong close to the limit, next to nothing
    assert abs(rule.cost.circularity.value) < 2e-2 * abs(rule.cost.usual)
    assert rule_sentences(network, idle)[0].startswith("Always")


def settings(algorithm: str, scheme: str = "independent", **more: Any) -> LearnerSettings:
    """Return the settings of a learner that learns next to nothing."""
    parameters: dict[str, Any] = {"policy_kwargs": {"net_arch": [8]}}
    if algorithm in ("PPO", "RecurrentPPO"):
        parameters |= {"n_steps": 8, "batch_size": 16, "n_epochs": 1}
    elif algorithm == "ARS":
        parameters = {"n_delta": 2, "n_top": 1}
    else:
        parameters |= {"learning_starts": 10, "buffer_size": 100, "batch_size": 16}
    if algorithm == "RecurrentPPO":
        parameters["policy_kwargs"]["lstm_hidden_size"] = 4
    given: dict[str, Any] = {"algorithm": algorithm, "scheme": scheme, "parameters": parameters}
    return LearnerSettings(**(given | more))


NORMALISED = Normalisation(observation=True, reward=False)
KINDS = {
    "independent": settings("PPO", normalise=NORMALISED),
    "joint": settings("SAC", "joint", normalise=NORMALISED),
    "remembering": settings("RecurrentPPO", "shared", policy="MlpLstmPolicy"),
    "central critic": settings("PPO", "shared", policy="CentralCriticPolicy", normalise=NORMALISED),
    "shared search": settings("ARS", "shared", policy="LinearPolicy"),
    "search": settings("ARS"),
    "td3": settings("TD3"),
}
OFTEN = ("independent", "remembering")


AGENTS = ["manufacture", "use_to_collection", "mine_to_refinery"]


def learnt(folder: Path, kind: str) -> Path:
    """Return a run of three agents of ``copper_net``, in episodes of six steps."""
    run = Run(steps=80, envs=2, engine="lockstep", evaluations=0)
    recipe = Recipe(name="small", title="small", run=run, learner=KINDS[kind])
    train("copper_net", recipe, directory=folder / "run", horizon=6, agents=AGENTS)
    return folder / "run"


@pytest.mark.medium
@pytest.mark.parametrize("kind", [k if k in OFTEN else pytest.param(k, marks=pytest.mark.slow) for k in KINDS])
def test_every_kind_of_policy_is_differentiated(tmp_path: Path, kind: str) -> None:
    """The function that is differentiated does, row by row, what the policy did; gradients add up."""
    policies = Trained(learnt(tmp_path, kind))
    env = policies.run.make_env(3)
    watching = Recorder(policies)
    usual = rollout(env, watching, seed=FIRST)
    seen = watching.episodes
    for agent in env.agents:
        name, policy = next(each for each in policies.policies.items() if agent in each[1].view.agents)
        acting, where, view = DifferentiablePolicy(policy), policy_columns(env, policy.view, agent), policy.view
        flat = {each: seen.observations[each].reshape(18, -1) for each in view.agents}
        place = view.row_agents.index(agent) if view.row_agents else 0
        rows = torch.as_tensor(view.rows(flat)[18 * place : 18 * (place + 1)].astype(np.float32))
        assert acting.remembers == (kind == "remembering")
        memory = tuple(map(torch.as_tensor, _memories(seen.memories[name], 3, place))) if acting.remembers else ()
        with torch.no_grad():
            acted = acting(rows, *memory).numpy()[:, where.entries]
        np.testing.assert_allclose(np.clip(acted, -1, 1), seen.actions[agent].reshape(18, -1), atol=1e-5)
        for names, places in zip(where.names, where.places, strict=True):
            whose, entry = where.sources[where.names.index(names)]
            assert env.observation_names[whose][entry] == names
            for column in places:
                np.testing.assert_array_equal(
                    rows[:, column], seen.observations[whose][:, :, entry].ravel().astype("f4")
                )
        if kind == "joint":
            assert set(where.names) == {name for each in AGENTS for name in env.observation_names[each]}
    for each in attribute_inputs(env, policies, Trained(tmp_path / "run"), seen, usual, FIRST):
        assert each.residual < 0.02 and each.share.sum() == pytest.approx(1.0)


@pytest.mark.medium
def test_a_run_is_explained_and_written(tmp_path: Path) -> None:
    """Text, tables and picture; a page of the run finds them, one of another checkpoint does not."""
    own_copper_run = learnt(tmp_path, "independent")
    run = Trained(own_copper_run).run
    assert read_reasons(run, "any") == ((), f"no reasons: cirl explain {run.path.name} finds them")
    found = explain(own_copper_run, episodes=3)
    assert found.prices is not None and len(found.inputs) == 3 and found.rules is not None
    written = write_reasons(found, own_copper_run / "reasons")
    assert {path.name for path in written} == {
        "reasons.txt", "reasons.json", "prices.csv", "inputs.csv", "rules.csv", "reasons.png",
    }  # fmt: skip
    sections, missing = read_reasons(run, found.checkpoint)
    assert not missing and "\n".join(sections[0][1]) in (own_copper_run / "reasons" / "reasons.txt").read_text("utf-8")
    with (own_copper_run / "reasons" / "inputs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    shares = [float(row["share"]) for row in rows if row["agent"] == "use_to_collection"]
    assert sum(shares) == pytest.approx(1.0) and shares == sorted(shares, reverse=True)
    assert "another checkpoint" in read_reasons(run, "000000001-best")[1]
    story = page_of_evaluation(evaluate(run, episodes=2))
    assert shown(page_html(story))["reasons"][1]["title"] == "Manufacture of products"
    told = json.loads((own_copper_run / "reasons" / "reasons.json").read_text())
    (own_copper_run / "reasons" / "reasons.json").write_text(json.dumps({**told, "sections": 3}))
    with pytest.raises(RunError, match=r"reasons\.json: cannot be read"):
        read_reasons(run, found.checkpoint)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"parts": ["inputs"]}, "a network has none; give a run"),
        ({"parts": ["price"]}, "unknown part 'price'. Did you mean 'prices'"),
        ({"min_service": 2.0}, r"min_service 2.0 must lie in \[0, 1\]"),
        ({"scenario": "nope"}, "unknown scenario 'nope'"),
    ],
)
def test_bad_questions_about_a_network(options: dict[str, Any], said: str) -> None:
    """Each is refused in words."""
    with pytest.raises(CirlError, match=said):
        cirl_marl.explain("copper_net", **options)


def test_bad_questions_about_a_run(copper_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Too few episodes, a scenario, and an extra that is missing."""
    with pytest.raises(CirlError, match="episodes must be a whole number of at least 2"):
        explain(copper_run, episodes=1)
    with pytest.raises(CirlError, match="a run has its own"):
        explain(copper_run, scenario="paper")
    monkeypatch.setitem(sys.modules, "captum.attr", None)
    with pytest.raises(CirlError, match=r"need captum: pip install 'cirl-marl\[explain\]'"):
        explain(copper_run)


def test_signals_have_units() -> None:
    """Stocks, flows, throughputs, set-points, time, services and what models show."""
    network = load_network("copper_net")
    units = {"stock of use": "kt", "flow of mine_to_refinery": "kt/day", "time": "day", "service level of x": "1"}
    for name, unit in units.items():
        assert signal_of(network, name).unit == unit
    assert signal_of(network, "stock of use").scale == network.compartments["use"].scale
    assert signal_of(network, "time").scale == network.episode.horizon * network.episode.control_interval
    assert signal_of(load_network("solids_net"), "truck.speed").scale == 1.0
