"""What a report in the browser shows: scenes of one network, each what became of it under somebody's control."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from scipy.special import stdtrit

from cirl_marl.controllers.basic import ProgressController
from cirl_marl.controllers.rollout import Rollout, rollout
from cirl_marl.controllers.schedule import Schedule
from cirl_marl.drawing.style import readable
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.evaluation.baselines import levels_to_demand
from cirl_marl.evaluation.comparison import FIGURES, Comparison
from cirl_marl.evaluation.pareto import ParetoFront
from cirl_marl.evaluation.sampling import SampledEpisodes
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.evaluation.statistics import SHARE, Aggregate, over_episodes
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import with_field_docs
from cirl_marl.optimum.mpc import SERVICE_FIRST, Optimum

QUANTILES = (0.025, 0.5, 0.975)
USUAL, PLAN = "business as usual", "plan of the bound"
CONFIDENCE = "mean of {} episodes, with its 95 % interval"
SAMPLES = "median of {} samples, and what 95 % of them lie within"


@with_field_docs
@dataclass(frozen=True, slots=True)
class Band:
    """A figure over time, with the ends of an interval if there is one."""

    value: Annotated[Floats, "shape (steps,)"]
    low: Annotated[Floats | None, "likewise; None without an interval"] = None
    high: Annotated[Floats | None, "likewise"] = None


@with_field_docs
@dataclass(frozen=True, slots=True)
class PageEpisode:
    """One course of a network: who acts, and what became of it."""

    name: Annotated[str, "who acts, or under which scenario"]
    network: Annotated[Network, "the network under its scenario"]
    agents: Annotated[tuple[str, ...], "who acts"]
    start: Annotated[Floats | None, "stocks at the start, shape (stores,), mass; None if there are several"]
    stock: Annotated[Floats, "stocks at the end of each interval, shape (steps, stores), mass"]
    flow: Annotated[Floats, "mean flows of each interval, shape (steps, arcs), mass/time"]
    controls: Annotated[Floats | None, "values of all controls, shape (steps, controls); None if they are not known"]
    circularity: Annotated[Band, "mean of λ over each interval, mass"]
    levels: Annotated[tuple[Band, ...], "level of each service"]
    about: Annotated[str, "what the bands are; empty if there are none"] = ""
    figures: Annotated[Mapping[str, Aggregate | None], "figures of whole episodes, of ``comparison.FIGURES``"] = field(
        default_factory=dict
    )


@with_field_docs
@dataclass(frozen=True, slots=True)
class PlanePoint:
    """A point in the plane of service and circularity."""

    name: Annotated[str, "of which series it is one"]
    service: Annotated[float, "mean level of the service that lacks most"]
    circularity: Annotated[float, "λ̄, mass"]
    about: Annotated[str, "what it is, further"] = ""


@with_field_docs
@dataclass(frozen=True, slots=True)
class ReportPage:
    """All that one page shows."""

    title: Annotated[str, "heading"]
    network: Annotated[Network, "the network that it is about"]
    scenes: Annotated[
        tuple[PageEpisode, ...], "the first is what the others are compared with; none for points alone"
    ] = ()
    points: Annotated[tuple[PlanePoint, ...], "what is drawn in the plane of service and circularity"] = ()
    front: Annotated[Floats, "levels of every service and the bound on λ̄ there, shape (levels, 2)"] = field(
        default_factory=lambda: np.empty((0, 2))
    )
    notes: Annotated[tuple[str, ...], "what a reader has to know"] = ()
    reasons: Annotated[tuple[tuple[str, tuple[str, ...]], ...], "headings with sentences that say why"] = ()


def page_of_alternatives(found: Sequence[Simulation]) -> ReportPage:
    """Return the page of ``cirl simulate``."""
    scenes = [
        _scene(each.name or readable(each.control), each.network, each.env.agents, each.start, each.rollout)
        for each in found
    ]
    network = found[0].network
    return ReportPage(_title(network), network, tuple(scenes), notes=(f"Start: {found[0].episode_start.description}.",))


def page_of_samples(found: SampledEpisodes, control: str) -> ReportPage:
    """Return the page of ``cirl simulate --samples``: flows and stocks are means, which balance as medians do not."""
    network, count = found.network, len(found.circularity)
    scene = PageEpisode(
        readable(control),
        network,
        network.agents,
        None,
        found.stock.mean(axis=0),
        found.flow.mean(axis=0),
        None,
        _quantiles(found.circularity),
        tuple(_quantiles(found.levels[:, s]) for s in range(len(network.services))),
        SAMPLES.format(count),
    )
    note = f"Flows and stocks are means of {count} samples of the uncertain numbers."
    return ReportPage(_title(network), network, (scene,), notes=(note,))


def page_of_schedule(found: Schedule) -> ReportPage:
    """Return the page of ``cirl plan``: business as usual, and what is planned."""
    network, start, note = found.network, found.start, found.note
    name = PLAN if found.control == "optimum" and not note else found.control or "trained"
    scenes = (
        _scene(USUAL, network, found.agents, start, found.usual),
        _scene(name, network, found.agents, start, found.rollout),
    )
    notes = [f"Start: {found.episode_start.description}.", *([note] if note else [])]
    return ReportPage(_title(network), network, scenes, notes=tuple(notes))


def page_of_comparison(found: Comparison, *, without: Sequence[str] = ()) -> ReportPage:
    """Return the page of ``cirl compare``, neutral control first, but for the rows ``without`` whom it shall be."""
    start = _first_start(found)
    scenes, points = [], []
    for row in sorted(found.rows, key=lambda row: row.name != "neutral"):
        if row.name in without:
            continue
        figures = {which: row.figure(which) for which in FIGURES}
        shown = (
            USUAL if row.name == "neutral" else f"trained, {readable(row.name)}" if row.seeds else readable(row.name)
        )
        for entry in row.entries:
            name = shown if len(row.entries) == 1 else f"{shown}, seed {entry.seed}"
            scenes.append(_scene(name, found.network, found.agents, start, entry.rollout, figures))
            service, circularity = float(entry.rollout.least_service.mean()), float(entry.circularity.mean())
            points.append(PlanePoint(shown, service, circularity, "" if entry.seed is None else f"seed {entry.seed}"))
    notes = [f"Flows, stocks and actions are those of the first of {found.episodes} episodes."]
    notes += [f"No bound: {found.baseline.reason}."] if found.baseline.reason else []
    return ReportPage(
        _title(found.network), found.network, tuple(scenes), tuple(points), found.baseline.front, tuple(notes)
    )


def add_plan(
    story: ReportPage,
    found: Comparison,
    env: MultiAgentVectorEnv,
    progress: Callable[[float], None] = lambda share: None,
) -> ReportPage:
    """Return the page with the best plan for the first episode.

    It serves as well as the first policy did there; where numbers are drawn, of which a plan knows nothing, as well as
    can be. ``env`` is one copy of what was compared in.

    Raises:
        CirlError: if a solver fails, or nobody acts.
    """
    level = None if env.uncertain else levels_to_demand(found.entries[0].rollout.episode_levels[0])
    controller = Optimum(min_service=level, service_weight=SERVICE_FIRST if level is None else None)
    watched = ProgressController(controller, progress)
    run = rollout(env, watched, seed=found.first_seed, progress=watched.acted)
    scene = _scene(PLAN, found.network, found.agents, _first_start(found), run)
    point = PlanePoint(PLAN, float(run.least_service[0]), float(run.episode_circularity[0]), "of the first episode")
    serving = "serving as well as can be" if level is None else "with no less service than the policies gave there"
    notes = [*story.notes, f"{PLAN.capitalize()}: for the first episode, {serving}."]
    notes += [f"{controller.note}."] if controller.note else []
    return replace(story, scenes=(*story.scenes, scene), points=(*story.points, point), notes=tuple(notes))


def page_of_front(found: ParetoFront) -> ReportPage:
    """Return the page of ``cirl pareto``: points alone, as nothing else of its episodes is kept."""
    names = {"plan": "plans", "trained": "trained", "neutral": USUAL}
    points = [
        PlanePoint(names[each.kind], each.service, each.circularity, _weighed(each.weight, each.seed))
        for each in found.points
        if each.kind in names
    ]
    notes = [f"No bound: {found.reason}."] if found.reason else []
    return ReportPage(_title(found.network), found.network, points=tuple(points), front=found.front, notes=tuple(notes))


def _weighed(weight: float | None, seed: int | None) -> str:
    return "" if weight is None else f"weight {weight:.3g}, seed {seed}"


def _first_start(found: Comparison) -> Floats:
    """Return the stocks with which the first episode begins, shape (stores,), mass."""
    env = MultiAgentVectorEnv(found.network, num_envs=1, agents=found.agents)
    env.reset(seed=found.first_seed)
    start: Floats = env.rows.stocks(env.physical.stock)[:, 0].copy()
    return start


def _scene(
    name: str,
    network: Network,
    agents: tuple[str, ...],
    start: Floats,
    run: Rollout,
    figures: Mapping[str, Aggregate | None] | None = None,
) -> PageEpisode:
    episodes = len(run.circularity_mean)
    figures = figures or {
        "circularity": over_episodes(run.episode_circularity),
        "service": over_episodes(run.episode_service, SHARE),
    }
    return PageEpisode(
        name,
        network,
        agents,
        start,
        run.stock,
        run.flow,
        run.controls,
        _mean(run.circularity_mean, np.inf),
        tuple(_mean(run.levels[:, s], 1.0) for s in range(len(network.services))),
        CONFIDENCE.format(episodes) if episodes > 1 else "",
        figures,
    )


def _mean(values: Floats, top: float) -> Band:
    """Return the mean over episodes, shape (episodes, steps), with its 95 % interval (Student's t)."""
    mean, count = values.mean(axis=0), len(values)
    if count < 2:
        return Band(mean)
    error = values.std(axis=0, ddof=1) / np.sqrt(count) * float(stdtrit(count - 1, 0.975))
    return Band(mean, mean - error, np.minimum(mean + error, np.maximum(top, mean)))


def _quantiles(values: Floats) -> Band:
    low, middle, high = np.quantile(values, QUANTILES, axis=0)
    return Band(middle, low, high)


def _title(network: Network) -> str:
    return network.title or readable(network.name)
