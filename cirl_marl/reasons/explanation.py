"""Everything that can be said of why: shadow prices of a network, and what the policies of a run look at and do."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from cirl_marl.controllers.rollout import first_seed, rollout, starting_stocks
from cirl_marl.definitions.catalogue import load_network
from cirl_marl.errors import CirlError, check_names, whole_number
from cirl_marl.evaluation.baselines import levels_to_demand
from cirl_marl.evaluation.comparison import part_of
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network import Network
from cirl_marl.network.declarations import frozen_record
from cirl_marl.network.uncertainty import expected_network
from cirl_marl.optimum import NoCertificate
from cirl_marl.reasons.attribution import AgentInputs, attribute_inputs, captum
from cirl_marl.reasons.interventions import Recorder
from cirl_marl.reasons.prices import ShadowPrices, shadow_prices
from cirl_marl.reasons.rules import LEAVES, TeamRules, distil_rules, sklearn_tree
from cirl_marl.reasons.state_prices import StatePrices, state_prices

PARTS = ("prices", "inputs", "rules")
"""What can be explained: of a network the first alone."""
TOP = 3


@frozen_record
class Explanation:
    """Reasons; what was not asked for, or cannot be had, is None."""

    network: Annotated[Network, "under its scenario"]
    about: Annotated[str, "a run's directory, or the network's name"]
    checkpoint: Annotated[str, "of the run that acts; empty for a network"] = ""
    episodes: Annotated[int, "in which policies were watched; 0 for a network"] = 0
    prices: Annotated[ShadowPrices | None, "shadow prices"] = None
    state_prices: Annotated[tuple[StatePrices, ...], "prices of stocks by the state of what disturbs a network"] = ()
    no_prices: Annotated[str, "why there are none; empty if there are, or nobody asked"] = ""
    inputs: Annotated[tuple[AgentInputs, ...], "what each agent looks at; empty if nobody asked"] = ()
    rules: Annotated[TeamRules | None, "what each agent does, in rules"] = None


def explain(
    source: str | Path | RunDirectory | Network,
    *,
    parts: Sequence[str] | None = None,
    scenario: str | None = None,
    min_service: float | None = None,
    episodes: int = 16,
    seed: int = 0,
    top: int = TOP,
    leaves: int = LEAVES,
    progress: Callable[[str, float], None] = lambda task, share: None,
) -> Explanation:
    """Explain a network, or what the policies of a run do in it.

    Shadow prices are those of the best plan from the middle of the initial ranges, of a disturbed network for what is
    expected, and beside them by the state of each disturbance; of a run, from the mean of the
    starts of its episodes, and with the service that the policies deliver there.

    Args:
        source: run directory, or name, file or object of a network.
        parts: some of PARTS; None: all that there are.
        scenario: of a network's definition; a run has its own.
        min_service: mean level demanded of every service; None: what the policies deliver, or 99 % of the highest.
        episodes: fresh episodes of a run, at least 2.
        seed: of these.
        top: how many inputs of an agent are held together.
        leaves: most leaves of a rule.
        progress: called with what is being done and the share of all that is done.

    Raises:
        CirlError: for input that cannot be used, a missing extra, or a service out of reach.
        RunError: if the run is incomplete, or its agents see anything but rows of numbers.
    """
    run = source if isinstance(source, RunDirectory) else None
    if isinstance(source, str | Path) and (Path(source) / "config.json").is_file():
        run = RunDirectory(source)
    possible = PARTS if run is not None else PARTS[:1]
    for part in parts or ():
        if part in PARTS and part not in possible:
            raise CirlError(f"explain {source}: {part} are those of policies, and a network has none; give a run")
        check_names("part", [part], possible, "explain: ")
    if run is None:
        assert not isinstance(source, RunDirectory)
        network = load_network(source, scenario=scenario)
        half = 0.5 if network.disturbed else 1.0
        plain, report = network, part_of(progress, "shadow prices", 0.0, half)
        if network.disturbed:
            plain = expected_network(network)
        prices = shadow_prices(plain, min_service=min_service, progress=report)
        by_state: tuple[StatePrices, ...] = ()
        if network.disturbed:
            by_state = state_prices(network, prices.level, part_of(progress, "prices by state", half, half))
        return Explanation(network=network, about=network.name, prices=prices, state_prices=by_state)
    if scenario is not None:
        raise CirlError(f"scenario '{scenario}' goes with a network; a run has its own")
    for name, value, least in (("episodes", episodes, 2), ("top", top, 1), ("leaves", leaves, 2)):
        whole_number(name, value, least)
    parts = possible if parts is None else tuple(parts)
    for part, module in (("inputs", captum), ("rules", sklearn_tree)):
        if part in parts:
            module()  # or an error, before anything is played
    return _explain_run(run, parts, min_service, episodes, first_seed(seed), top, leaves, progress)


def _explain_run(
    run: RunDirectory,
    parts: Sequence[str],
    min_service: float | None,
    episodes: int,
    seed: int,
    top: int,
    leaves: int,
    progress: Callable[[str, float], None],
) -> Explanation:
    from cirl_marl.learners.interface import Trained  # it needs torch

    policies, env = Trained(run), run.make_env(episodes, uncertain=False)
    start = np.asarray(starting_stocks(env, seed).mean(axis=0))
    share, steps = 1.0 / (1 + len(parts)), itertools.count()

    def report(name: str) -> Callable[[float], None]:
        return part_of(progress, name, next(steps) * share, share)

    recorder = Recorder(policies)
    usual = rollout(env, recorder, seed=seed, progress=report("episodes"))
    explanation = Explanation(
        network=env.network, about=str(run.path), checkpoint=policies.checkpoint.name, episodes=episodes
    )
    if "prices" in parts:
        level = levels_to_demand(usual.episode_levels.mean(axis=0)) if min_service is None else min_service
        options: dict[str, Any] = {"agents": env.agents, "progress": report("shadow prices")}
        try:
            explanation = replace(explanation, prices=shadow_prices(env.network, start, min_service=level, **options))
        except NoCertificate as missing:
            explanation = replace(explanation, no_prices=str(missing))
    if "inputs" in parts:
        record, twins, report_inputs = recorder.episodes, Trained(run), report("what agents look at")
        inputs = attribute_inputs(env, policies, twins, record, usual, seed, top=top, progress=report_inputs)
        explanation = replace(explanation, inputs=inputs)
    if "rules" in parts:
        rules = distil_rules(env, policies, usual, seed, leaves=leaves, progress=report("rules"))
        explanation = replace(explanation, rules=rules)
    return explanation
