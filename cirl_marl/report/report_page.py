"""What a report in the browser shows: episodes of one network, each what became of it under somebody's control."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, replace
from typing import Annotated

import numpy as np

from cirl_marl.controllers.episode_quantities import EpisodeQuantity, QuantityKind, episode_quantities
from cirl_marl.controllers.indicators import indicators
from cirl_marl.controllers.rollout import Rollout, rollout
from cirl_marl.controllers.schedule import Schedule
from cirl_marl.drawing.style import readable
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.evaluation.assessment import CONTROLLERS, Evaluation
from cirl_marl.evaluation.baselines import levels_to_demand
from cirl_marl.evaluation.comparison import FIGURES, Comparison
from cirl_marl.evaluation.pareto import ParetoFront
from cirl_marl.evaluation.sampling import SampledEpisodes
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.evaluation.statistics import SHARE, Aggregate, mean_interval, over_episodes
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.mpc import SERVICE_FIRST
from cirl_marl.optimum.open_loop import Optimum
from cirl_marl.report.explanations import read_reasons
from cirl_marl.report.samples import SHOWN
from cirl_marl.report.tradeoffs import worst_notes

QUANTILES = (0.025, 0.5, 0.975)
BANDS: tuple[QuantityKind, ...] = ("circularity", "service", "disturbance", "account")
"""Kinds of quantities that have bands."""
USUAL, PLAN = "business as usual", "plan of the bound"
CONFIDENCE = "mean of {} episodes, with its 95 % interval"
SAMPLES = "median of {} samples, and what 95 % of them lie within"


@positional_record
class Band:
    """A figure over time, with the ends of an interval if there is one."""

    value: Annotated[Floats, "shape (steps,)"]
    low: Annotated[Floats | None, "likewise; None without an interval"] = None
    high: Annotated[Floats | None, "likewise"] = None


@positional_record
class PageEpisode:
    """One trajectory of a network: who acts, and what became of it."""

    name: Annotated[str, "who acts, or under which scenario"]
    network: Annotated[Network, "the network under its scenario"]
    agents: Annotated[tuple[str, ...], "who acts"]
    rollout: Annotated[
        Rollout, "what became of it; the start is NaN, and controls and contents have no rows, if unknown"
    ]
    bands: Annotated[Mapping[QuantityKind, tuple[Band, ...]], "of λ, services, disturbances and accounts, by kind"]
    about: Annotated[str, "what the bands are; empty if there are none"] = ""
    figures: Annotated[Mapping[str, Aggregate | None], "figures of whole episodes, of ``comparison.FIGURES``"] = field(
        default_factory=dict
    )


@positional_record
class PlanePoint:
    """A point in the plane of service and circularity."""

    name: Annotated[str, "of which series it is one"]
    service: Annotated[float, "mean level of the service that lacks most"]
    circularity: Annotated[float, "λ̄, mass"]
    about: Annotated[str, "what it is, further"] = ""


@positional_record
class ReportPage:
    """All that one page shows."""

    title: Annotated[str, "heading"]
    network: Annotated[Network, "the network that it is about"]
    episodes: Annotated[tuple[PageEpisode, ...], "the first is what the others are compared with"] = ()
    points: Annotated[tuple[PlanePoint, ...], "what is drawn in the plane of service and circularity"] = ()
    front: Annotated[Floats, "levels of every service and the bound on λ̄ there, shape (levels, 2)"] = field(
        default_factory=lambda: np.empty((0, 2))
    )
    notes: Annotated[tuple[str, ...], "what a reader has to know"] = ()
    reasons: Annotated[tuple[tuple[str, tuple[str, ...]], ...], "headings with sentences that say why"] = ()


def page_of_alternatives(simulations: Sequence[Simulation]) -> ReportPage:
    """Return the page of ``cirl simulate``."""
    network, note = simulations[0].network, f"Start: {simulations[0].episode_start.description}."
    names = (case.name or readable(case.control) for case in simulations)
    cases = zip(names, simulations, strict=True)
    episodes = tuple(_episode(name, case.network, case.env.agents, case.rollout) for name, case in cases)
    return ReportPage(_title(network), network, episodes, notes=(note,))


def page_of_samples(samples: SampledEpisodes, control: str) -> ReportPage:
    """Return the page of ``cirl simulate --samples``, with single ones beside their bands.

    Flows and stocks are means, which balance as medians do not.
    """
    network, run, count = samples.network, samples.rollout, len(samples.factors)
    bands = _bands(network, run, lambda quantity, values: _quantiles(values))
    unknown = replace(run, start=np.full_like(run.start, np.nan), controls=run.controls[:0], contents=run.contents[:0])
    mean = replace(unknown, stock=run.stock.mean(axis=0), flow=run.flow.mean(axis=0))
    episode = PageEpisode(readable(control), network, network.agents, mean, bands, SAMPLES.format(count))

    def draw(i: int) -> PageEpisode:
        bands = _bands(network, run, lambda quantity, values: Band(values[i]))
        single = replace(mean, stock=run.stock[i], flow=run.flow[i])
        return PageEpisode(f"sample {i}", network, network.agents, single, bands)

    draws = map(draw, range(min(SHOWN, count)))
    note = f"Flows and stocks are means of {count} samples of what is uncertain or disturbed."
    return ReportPage(_title(network), network, (episode, *draws), notes=(note,))


def page_of_schedule(schedule: Schedule) -> ReportPage:
    """Return the page of ``cirl plan``: business as usual, and what is planned."""
    network, note = schedule.network, schedule.note
    name = PLAN if schedule.control == "optimum" and not note else schedule.control or "trained"
    outcomes = ((USUAL, schedule.usual), (name, schedule.rollout))
    episodes = tuple(_episode(title, network, schedule.agents, outcome) for title, outcome in outcomes)
    notes = (f"Start: {schedule.episode_start.description}.", *filter(None, (schedule.proof, note)))
    return ReportPage(_title(network), network, episodes, notes=notes)


def page_of_comparison(comparison: Comparison, *, without: Sequence[str] = ()) -> ReportPage:
    """Return the page of ``cirl compare``, neutral control first, but for the rows ``without`` whom it shall be."""
    network = comparison.network
    episodes, points = [], []
    for row in sorted(comparison.rows, key=lambda row: row.name != "neutral"):
        if row.name in without:
            continue
        figures = {name: row.figure(name) for name in FIGURES}
        title = f"trained, {readable(row.name)}" if row.seeds else readable(row.name)
        title = USUAL if row.name == "neutral" else title
        for entry in row.entries:
            seed = "" if entry.seed is None else f"seed {entry.seed}"
            name = title if len(row.entries) == 1 else f"{title}, seed {entry.seed}"
            episodes.append(_episode(name, network, comparison.agents, entry.rollout, figures))
            service, circularity = float(entry.rollout.least_service.mean()), float(entry.circularity.mean())
            points.append(PlanePoint(title, service, circularity, seed))
    baseline = comparison.baseline
    notes = [f"Flows, stocks and actions are those of the first of {comparison.episodes} episodes."]
    notes += [f"No bound: {baseline.reason}."] if baseline.reason else []
    if network.disturbed:
        notes += ["Worst: mean of the 5 % worst episodes of each figure by itself.", *worst_notes(comparison)]
    return ReportPage(_title(network), network, tuple(episodes), tuple(points), baseline.front, tuple(notes))


def add_plan(
    page: ReportPage,
    comparison: Comparison,
    env: MultiAgentVectorEnv,
    progress: Callable[[float], None] = lambda share: None,
) -> ReportPage:
    """Return the page with the best plan for the first episode.

    It serves as well as the first policy did there; where numbers are drawn, of which a plan knows nothing, as well as
    can be. ``env`` is one copy of what was compared in.

    Raises:
        CirlError: if a solver fails, or nobody acts.
    """
    level = None if env.dynamics.factors.ranges else levels_to_demand(comparison.entries[0].rollout.episode_levels[0])
    optimum = Optimum(min_service=level, service_weight=SERVICE_FIRST if level is None else None)
    outcome = rollout(env, optimum, seed=comparison.first_seed, progress=progress)
    episode = _episode(PLAN, comparison.network, comparison.agents, outcome)
    service, circularity = float(outcome.least_service[0]), float(outcome.episode_circularity[0])
    point = PlanePoint(PLAN, service, circularity, "of the first episode")
    condition = "serving as well as can be" if level is None else "with no less service than the policies gave there"
    notes = [*page.notes, f"{PLAN.capitalize()}: for the first episode, {condition}."]
    notes += [f"{optimum.note}."] if optimum.note else []
    return replace(page, episodes=(*page.episodes, episode), points=(*page.points, point), notes=tuple(notes))


def page_of_evaluation(evaluation: Evaluation, progress: Callable[[float], None] = lambda share: None) -> ReportPage:
    """Return the page of a run: business as usual, the policies, and the plan of the bound, which is solved here.

    Reasons are on it if they were found of the checkpoint that acts; else it says how to find them. ``progress`` is
    called with the share of the plan that is done.
    """
    run, comparison = evaluation.run, evaluation.comparison
    page = page_of_comparison(comparison, without=CONTROLLERS[1:])
    reasons, advice = read_reasons(run, comparison.entries[0].checkpoint)
    notes = (*page.notes, f"{advice}.") if advice else page.notes
    return add_plan(replace(page, reasons=reasons, notes=notes), comparison, run.make_env(1), progress)


def page_of_front(front: ParetoFront) -> ReportPage:
    """Return the page of ``cirl pareto``: points alone, as nothing else of its episodes is kept."""
    names = {"plan": "plans", "trained": "trained", "neutral": USUAL}
    points = []
    for point in front.points:
        if point.kind in names:
            about = "" if point.weight is None else f"weight {point.weight:.3g}, seed {point.seed}"
            points.append(PlanePoint(names[point.kind], point.service, point.circularity, about))
    notes = (f"No bound: {front.reason}.",) if front.reason else ()
    return ReportPage(_title(front.network), front.network, points=tuple(points), front=front.front, notes=notes)


def _episode(
    name: str,
    network: Network,
    agents: tuple[str, ...],
    outcome: Rollout,
    figures: Mapping[str, Aggregate | None] | None = None,
) -> PageEpisode:
    count = len(outcome.circularity_mean)
    figures = figures or {
        "circularity": over_episodes(outcome.episode_circularity),
        "service": over_episodes(outcome.episode_service, SHARE),
    }
    found = indicators(network, outcome.mean_flow)
    shares = {"recycling_rate": found.recycling_rate, "recycled_content": found.recycled_content} if found else {}
    figures = {**figures, **{which: Aggregate(share, np.nan, np.nan) for which, share in shares.items()}}
    accounts = episode_quantities(network, "account")
    figures |= {f"account:{account.of}": over_episodes(account.totals(outcome)) for account in accounts}
    about = CONFIDENCE.format(count) if count > 1 else ""
    return PageEpisode(name, network, agents, outcome, _bands(network, outcome, _mean), about, figures)


def _bands(
    network: Network, run: Rollout, band: Callable[[EpisodeQuantity, Floats], Band]
) -> dict[QuantityKind, tuple[Band, ...]]:
    quantities = {kind: episode_quantities(network, kind) for kind in BANDS}
    return {kind: tuple(band(part, part.values(run)) for part in parts) for kind, parts in quantities.items()}


def _mean(quantity: EpisodeQuantity, values: Floats) -> Band:
    """Return the mean over episodes, shape (episodes, steps), with its interval, of a level up to 1 at most."""
    mean, *ends = mean_interval(values, (-np.inf, 1.0 if quantity.kind == "service" else np.inf))
    return Band(mean, *ends) if len(values) > 1 else Band(mean)


def _quantiles(values: Floats) -> Band:
    low, median, high = np.quantile(values, QUANTILES, axis=0)
    return Band(median, low, high)


def _title(network: Network) -> str:
    return network.title or readable(network.name)
