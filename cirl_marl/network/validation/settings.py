"""What is wrong with the clock, the objective, the observation and the services of a network."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress

from cirl_marl.errors import CirlError, unknown_names
from cirl_marl.network.calendar import LAST_YEAR, years
from cirl_marl.network.compartment_model import ContinuousModel, DiscreteTimeModel, OwnStepModel
from cirl_marl.network.declarations import bound_problems
from cirl_marl.network.elements import MAX_STEPS, Compartment, Episode, Law
from cirl_marl.network.specification import Specification
from cirl_marl.network.units import factor


def setting_problems(network: Specification) -> Iterator[str]:
    """Yield every mistake in the settings of ``network``."""
    episode, objective = network.episode, network.objective
    for part in (episode, objective, network.observation):
        yield from bound_problems(part)
    if episode.solver != "exact" or episode.solver_step is not None:
        yield from _step_problems(episode, network.time_unit)
    if episode.solver == "exact":
        continuous = any(isinstance(c.model, ContinuousModel | OwnStepModel) for c in (*network.nodes, *network.arcs))
        if continuous or any(arc.law is Law.COMPARTMENT for arc in network.arcs):
            yield "solver 'exact' knows no continuous inner physics: a network with models needs 'rk4' or 'euler'"
    compartments = (*network.nodes, *network.arcs)
    for compartment in compartments:
        yield from _clock_problems(network, compartment)
    with_set_point = dict.fromkeys(c.id for c in compartments if c.set_point is not None)
    yield from repetitions("objective.tracked", objective.tracked)
    yield from repetitions("observation.nodes", network.observation.nodes)
    yield from unknown_names("compartment with a set_point", objective.tracked, with_set_point, "objective.tracked: ")
    if (network.observation.mode == "stocks") != bool(network.observation.nodes):
        yield "observation: mode 'stocks', and only that mode, lists its nodes"
    inner = [f"{c.id}.{name}" for c in compartments if c.model is not None for name in c.model.state_names]
    signals = dict.fromkeys((*(node.id for node in network.nodes), *inner))
    yield from unknown_names("node or inner state", network.observation.nodes, signals, "observation: ")


def calendar_problems(network: Specification) -> Iterator[str]:
    """Yield it if the calendar ends before the episode."""
    episode = network.episode
    with suppress(CirlError):  # an unknown unit is a problem of its own
        if episode.start is not None:
            end = years(network, episode.control_interval * episode.horizon)
            if not end < LAST_YEAR:
                yield f"episode: it ends in the year {end:g}, after the calendar; is control_interval in another unit?"


def _clock_problems(network: Specification, compartment: Compartment) -> Iterator[str]:
    model = compartment.model
    if model is None:
        return
    try:
        factor(model.time_unit, "s")
    except CirlError as error:
        yield f"'{compartment.id}': model '{model.kind}': time_unit: {error}"
        return
    try:
        interval = network.episode.control_interval * factor(network.time_unit, model.time_unit)
    except CirlError:
        return  # a problem of its own, units.time
    if isinstance(model, DiscreteTimeModel) and not math.isclose(interval, model.interval, rel_tol=1e-9):
        steps = f"in steps of {model.interval:g} {model.time_unit}"
        actual = f"the control interval is {interval:g} {model.time_unit}"
        yield f"'{compartment.id}': model '{model.kind}' moves {steps}; {actual}"


def _step_problems(episode: Episode, unit: str) -> Iterator[str]:
    step = episode.solver_step
    if step is None or not (math.isfinite(step) and step > 0):
        yield f"solver '{episode.solver}' needs a positive solver_step, got {step}"
        return
    interval, ratio = episode.control_interval, episode.control_interval / step
    if not math.isfinite(interval):
        return  # a problem of its own
    if ratio > MAX_STEPS:
        excess = f"{ratio:.6g} solver steps of {step:g} {unit}, more than {MAX_STEPS:,}"
        yield f"control_interval {interval:g} {unit} is {excess}. Is solver_step in the wrong unit?"
    elif not is_whole(ratio) or round(ratio) < 1:
        yield f"control_interval {interval} is not a whole number of solver steps of {step} ({ratio:.6g} steps)"


def repetitions(subject: str, names: Iterable[str]) -> Iterator[str]:
    """Yield names that a list has twice."""
    for name, times in Counter(names).items():
        if times > 1:
            yield f"{subject}: names '{name}' twice"


def is_whole(ratio: float) -> bool:
    """Return whether a ratio of times is a whole number, but for rounding."""
    return math.isfinite(ratio) and math.isclose(ratio, round(ratio), rel_tol=1e-9, abs_tol=1e-9)
