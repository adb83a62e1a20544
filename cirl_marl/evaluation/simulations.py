"""Alternatives of a network, which are scenarios and controllers from the same seed, and what differs between them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from cirl_marl.controllers.basic import ProgressController
from cirl_marl.controllers.rollout import EpisodeStart, Rollout, episode_start, rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Network
from cirl_marl.network.declared import itemised
from cirl_marl.optimum.bounds import relative
from cirl_marl.optimum.registry import SETTABLE, named_controller

ROUND_OFF = 1e-12
"""Share of the largest value of its kind by which a quantity may differ and yet count as the same."""

QuantityKind = Literal["circularity", "service", "flow", "stock"]
NAMES: Mapping[QuantityKind, str] = {
    "circularity": "mean circularity",
    "service": "mean level of service {}",
    "flow": "total flow of {}",
    "stock": "final stock of {}",
}
"""What quantities are called, {} standing for the id of the service, arc or node."""


@itemised
@dataclass(frozen=True, slots=True)
class Simulation:
    """One episode of a network under one scenario and one controller."""

    name: Annotated[str, "scenario, controller or both, whichever there are several of; empty if it is alone"]
    control: Annotated[str, "name of the controller"]
    env: Annotated[MultiAgentVectorEnv, "one copy, in which it was simulated; alternatives of one scenario share it"]
    begun: Annotated[EpisodeStart, "where the episode began"]
    start: Annotated[Floats, "stocks there, shape (stores,), mass"]
    rollout: Annotated[Rollout, "what came of it"]

    @property
    def network(self) -> Network:
        """The network under the scenario."""
        return self.env.network


@itemised
@dataclass(frozen=True, slots=True)
class ComparedQuantity:
    """A figure of a whole episode in each of A alternatives."""

    kind: Annotated[QuantityKind, "λ̄, mean level of a service, mass that an arc moved, or stock of a node at the end"]
    of: Annotated[str, "id of the service, arc or node; empty for λ̄"]
    unit: Annotated[str, "that of the values"]
    values: Annotated[Floats, "shape (A,); NaN where a scenario has no such service, arc or node"]
    round_off: Annotated[float, "largest difference at which values count as the same"]

    @property
    def name(self) -> str:
        """What it is, in words."""
        return NAMES[self.kind].format(self.of)

    @property
    def differences(self) -> Floats:
        """Differences to the first alternative, shape (A,), in the unit of the values; NaN where one is missing."""
        difference: Floats = self.values - self.values[0]
        return difference

    @property
    def relative_differences(self) -> Floats:
        """Differences in units of the first value's magnitude, shape (A,); NaN where that is 0 or one is missing."""
        return relative(self.differences, self.values[0])

    @property
    def rank(self) -> float:
        """Largest relative difference to the first value; 0 if all count as the same.

        What does not exist counts as 0, and a first value below ``round_off`` as ``round_off``.
        """
        there = np.nan_to_num(self.values)
        largest = float(np.abs(there - there[0]).max())
        return largest / max(abs(float(there[0])), self.round_off) if largest > self.round_off else 0.0


def simulate_alternatives(
    network: str | Path | Network,
    *,
    scenarios: Sequence[str | None] = (None,),
    controls: Sequence[str] = ("neutral",),
    held: Mapping[str, float] | None = None,
    steps: int | None = None,
    seed: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> list[Simulation]:
    """Simulate every scenario under every controller, each from the same seed.

    Each begins at ``episode_start(env, seed)``. Scenarios with the same nodes and initial ranges thus begin with the
    same stocks.

    Args:
        network: catalogue name, path of a definition file, or a network.
        scenarios: of the definition; None is the default, physical one.
        controls: names of controllers, of CONTROLLERS.
        held: agent → constant value in [−1, 1], for those of the controllers that take such values.
        steps: control intervals of each episode; None takes the definition's.
        seed: of the evaluation whose first episode is simulated; None begins in the middle of all initial ranges.
        progress: called with the share of all work that is done.

    Returns:
        Scenario by scenario, and in each controller by controller, as given.

    Raises:
        CirlError: before anything is simulated, if a scenario or controller is unknown, given twice or not at all, if
            nobody takes ``held``, or if units, beginnings or durations of scenarios differ, naming both. Later, if a
            controller cannot act in a scenario; names it.
    """
    envs = [MultiAgentVectorEnv(network, num_envs=1, scenario=scenario, horizon=steps) for scenario in scenarios]
    _refuse(envs, controls, held)
    cases = list(product(envs, controls))
    controllers = [named_controller(control, constants=held if control in SETTABLE else None) for _, control in cases]
    simulated = []
    for i, ((env, control), controller) in enumerate(zip(cases, controllers, strict=True)):
        choices = ((env.network.scenario_name, envs), (control, controls))
        name = ", ".join(chosen for chosen, among in choices if len(among) > 1)
        watched = ProgressController(controller, partial(_tell, progress, i, len(cases)))
        try:
            simulated.append(_simulated(name, control, env, watched, seed))
        except CirlError as error:
            if not name:
                raise
            raise CirlError(f"{name}: {error}") from error
    return simulated


def _refuse(envs: Sequence[MultiAgentVectorEnv], controls: Sequence[str], held: Mapping[str, float] | None) -> None:
    """Raise what ``simulate_alternatives`` raises of scenarios and controllers that exist."""
    for kind, names in (("scenario", [env.network.scenario_name for env in envs]), ("control", controls)):
        if not names:
            raise CirlError(f"no {kind} is given")
        for name in names:
            if names.count(name) > 1:
                raise CirlError(f"{kind} '{name}' is given {names.count(name)} times")
    if held and not set(controls) & set(SETTABLE):
        raise CirlError(f"values of single agents go with {' or '.join(SETTABLE)}, not with {', '.join(controls)}")
    for env in envs[1:]:
        if found := list(_obstacles(envs[0].network, env.network)):
            both = f"'{envs[0].network.scenario_name}' and '{env.network.scenario_name}'"
            raise CirlError(f"network '{env.network.name}': scenarios {both} cannot be compared: {'; '.join(found)}")


def _simulated(
    name: str, control: str, env: MultiAgentVectorEnv, watched: ProgressController, seed: int | None
) -> Simulation:
    begun = episode_start(env, seed)
    begun.reset(env)
    start = env.rows.stocks(env.physical.stock)[:, 0].copy()
    run = rollout(env, watched, seed=begun.seed, start=begun.initial_state, progress=watched.acted)
    return Simulation(name, control, env, begun, start, run)


def _tell(progress: Callable[[float], None], done: int, of: int, share: float) -> None:
    """Tell the share of all episodes that is done, when ``done`` of them and a share of the next are."""
    progress((done + share) / of)


def _obstacles(one: Network, other: Network) -> Iterator[str]:
    """Yield what keeps episodes of two scenarios from being compared, with the values of both."""
    units = {"mass": (one.mass_unit, other.mass_unit), "time": (one.time_unit, other.time_unit)}
    yield from (f"unit of {what} {mine} and {its}" for what, (mine, its) in units.items() if mine != its)
    if one.time_unit != other.time_unit:
        return  # times would differ even where they are the same
    intervals = (one.objective.reference_interval, other.objective.reference_interval)
    if intervals[0] != intervals[1]:
        yield f"reference interval of λ {intervals[0]:g} and {intervals[1]:g} {one.time_unit}"
    ours, theirs = one.episode, other.episode
    if ours.start != theirs.start:
        yield f"start on the calendar {ours.start or 'none'} and {theirs.start or 'none'}"
    if not math.isclose(ours.horizon * ours.control_interval, theirs.horizon * theirs.control_interval):
        mine, its = (
            f"{each.horizon} intervals of {each.control_interval:g} {one.time_unit}" for each in (ours, theirs)
        )
        advice = "; give a number of steps for both" if ours.control_interval == theirs.control_interval else ""
        yield f"horizon {mine} and {its}{advice}"


def rank_quantities(found: Sequence[Simulation]) -> list[ComparedQuantity]:
    """Return the figures of episodes of ``simulate_alternatives``, those first that differ most.

    They are λ̄, the mean level of each service, the mass that each arc moved in the episode, and the stock of each node
    at the end.

    The order is that of ``ComparedQuantity.rank``. Round-off is ``ROUND_OFF`` of the largest value of the same kind.
    """
    figures = [_figures(each) for each in found]
    quantities: list[ComparedQuantity] = []
    for kind in NAMES:
        ids = list(dict.fromkeys(id_ for each in figures for id_ in each[kind]))
        values = np.array([[each[kind].get(id_, math.nan) for each in figures] for id_ in ids])
        unit = "1" if kind == "service" else found[0].network.mass_unit
        round_off = ROUND_OFF * float(np.abs(np.nan_to_num(values)).max(initial=0.0))
        quantities += (ComparedQuantity(kind, id_, unit, row, round_off) for id_, row in zip(ids, values, strict=True))
    return sorted(quantities, key=lambda quantity: -quantity.rank)


def _figures(alternative: Simulation) -> dict[QuantityKind, dict[str, float]]:
    """Return the figures of an episode by kind and id."""
    network, run = alternative.network, alternative.rollout
    duration = network.episode.horizon * network.episode.control_interval
    levels, moved, stocks = run.episode_levels[0], run.mean_flow * duration, run.final_stock
    return {
        "circularity": {"": float(run.episode_circularity[0])},
        "service": dict(zip((service.id for service in network.services), levels.tolist(), strict=True)),
        "flow": dict(zip((arc.id for arc in network.arcs), moved.tolist(), strict=True)),
        "stock": dict(zip((node.id for node in network.stores), stocks.tolist(), strict=True)),
    }
