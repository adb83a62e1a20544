"""Simulated episodes of a network, and alternatives: scenarios and controllers from the same seed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from cirl_marl.controllers.basic import Controller
from cirl_marl.controllers.episode_quantities import QuantityKind, episode_quantities
from cirl_marl.controllers.outcome import outcome_lines
from cirl_marl.controllers.pyramids import pyramids
from cirl_marl.controllers.rollout import EpisodeStart, Rollout, episode_start, interval_ends
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Network
from cirl_marl.network.calendar import time_columns
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.registry import SETTABLE, named_controller
from cirl_marl.records.files import write_table


@positional_record
class Simulation:
    """One episode of a network under one scenario and one controller."""

    name: Annotated[str, "scenario, controller or both, whichever there are several of; empty if it is alone"]
    control: Annotated[str, "name of the controller"]
    env: Annotated[MultiAgentVectorEnv, "one copy, in which it was simulated; alternatives of one scenario share it"]
    episode_start: Annotated[EpisodeStart, "where the episode began"]
    rollout: Annotated[Rollout, "what came of it"]

    @property
    def network(self) -> Network:
        """The network under the scenario."""
        return self.env.network

    def __str__(self) -> str:
        """Say where the episode begins and what comes of it."""
        return "\n".join(outcome_lines(self.network, self.rollout, self.episode_start))

    def table(self) -> tuple[list[str], list[list[object]]]:
        """Return header and rows: a row for the start and one for the end of each interval.

        Columns are year or date at the end, if the network has a start on the calendar, λ at the end and the mean of λ,
        the service level, amounts on accounts, stocks at the end, mean flows, what passes through nodes without stock,
        masses on the way, inner states that an agent may see, mean ages, what disturbed the interval, and contents of
        substances.
        """
        network, run, dynamics = self.network, self.rollout, self.env.dynamics
        mass, time, lines, inner = network.mass_unit, network.time_unit, dynamics.batches.lines, dynamics.inner

        def columns(*kinds: QuantityKind) -> Iterator[tuple[str, float | None, Floats]]:
            """Yield heading, value at the start and values in the intervals of each quantity of some kinds."""
            for quantity in episode_quantities(network, *kinds):
                first = float(run.start[quantity.place]) if quantity.kind == "stock" else None
                yield quantity.heading, first, quantity.values(run)[0]

        through = zip(
            [node.id for node in network.nodes if not node.stores], network.throughput(run.flow.T), strict=True
        )
        loads = zip([line.id for line in lines], run.start_load.tolist(), run.load.T, strict=True)
        table: list[tuple[str, float | None, Floats]] = [
            (f"circularity at the end ({mass})", None, run.circularity[0]),
            *columns("circularity"),
            ("service level", None, run.service[0]),
            *columns("account", "stock", "flow"),
            *((f"throughput of {id_} ({mass}/{time})", None, flow) for id_, flow in through),
            *((f"mass on {id_} ({mass})", first, load) for id_, first, load in loads),
            *zip([inner.names[row] for row in inner.visible], run.start_inner.tolist(), run.inner.T, strict=True),
            *((f"mean age of {p.node} ({time})", float(p.mean_age[0]), p.mean_age[1:]) for p in pyramids(network, run)),
            *columns("disturbance", "content"),
        ]
        header, clock = time_columns(network, np.append(0.0, interval_ends(network)))
        rows = zip(*([first, *values.tolist()] for _, first, values in table), strict=True)
        headings = [*header, *(heading for heading, _, _ in table)]
        return headings, [[*at, *figures] for at, figures in zip(clock, rows, strict=True)]

    def write(self, path: str | Path) -> Path:
        """Write ``table`` to a CSV file, whole or not at all, and return its path; missing folders are made."""
        return write_table(Path(path), *self.table())


def simulate(
    network: str | Path | Network,
    control: str | Controller = "neutral",
    *,
    scenario: str | None = None,
    constants: Mapping[str, float] | None = None,
    steps: int | None = None,
    seed: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Simulation:
    """Simulate one episode of a network under one controller, without learning.

    >>> import cirl_marl
    >>> simulation = cirl_marl.simulate("net_zero", "scripted", steps=20)
    >>> simulation.rollout.flow.shape == (20, len(simulation.network.arcs))
    True

    Args:
        network: catalogue name, path of a definition file, or a network.
        control: who acts: a name of CONTROLLERS, or a controller.
        scenario: of the definition; None is the default, physical one.
        constants: agent → constant value in [−1, 1], for constant or scripted control.
        steps: control intervals of the episode; None takes the definition's.
        seed: of the evaluation whose first episode is simulated; None begins in the middle of all initial ranges.
        progress: called with the share of the work that is done.

    Returns:
        The episode, with λ (mass), service levels, stocks (mass) and flows (mass/time) of each interval in
        ``rollout``; ``write`` makes a CSV file of them.

    Raises:
        CirlError: if scenario or controller is unknown, does not fit the network, or does not take ``constants``.
    """
    options: dict[str, Any] = {"constants": constants, "steps": steps, "seed": seed, "progress": progress}
    return simulate_alternatives(network, scenarios=[scenario], controls=[control], **options)[0]


def simulate_alternatives(
    network: str | Path | Network,
    *,
    scenarios: Sequence[str | None] = (None,),
    controls: Sequence[str | Controller] = ("neutral",),
    constants: Mapping[str, float] | None = None,
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
        controls: names of CONTROLLERS, or controllers.
        constants: agent → constant value in [−1, 1], for those of the controllers that take such values.
        steps: control intervals of each episode; None takes the definition's.
        seed: of the evaluation whose first episode is simulated; None begins in the middle of all initial ranges.
        progress: called with the share of all work that is done.

    Returns:
        Scenario by scenario, and in each controller by controller, as given.

    Raises:
        CirlError: before anything is simulated, if a scenario or controller is unknown, given twice or not at all, if
            nobody takes ``constants``, or if units, beginnings or durations of scenarios differ, naming both. Later, if
            a controller cannot act in a scenario; names it.
    """
    envs = [MultiAgentVectorEnv(network, num_envs=1, scenario=scenario, horizon=steps) for scenario in scenarios]
    names = [control if isinstance(control, str) else type(control).__name__ for control in controls]
    _refuse(envs, names, constants)
    cases = list(product(envs, names))
    controllers = [_controller(control, constants) for _ in envs for control in controls]
    simulations = []
    for i, ((env, control), controller) in enumerate(zip(cases, controllers, strict=True)):
        choices = ((env.network.scenario_name, envs), (control, names))
        name = ", ".join(choice for choice, among in choices if len(among) > 1)
        origin = episode_start(env, seed)

        def report(share: float, done: int = i) -> None:
            progress((done + share) / len(cases))

        try:
            run = origin.play(env, controller, progress=report)
        except CirlError as error:
            if not name:
                raise
            raise CirlError(f"{name}: {error}") from error
        simulations.append(Simulation(name, control, env, origin, run))
    return simulations


def _controller(control: str | Controller, constants: Mapping[str, float] | None) -> Controller:
    if isinstance(control, Controller):
        return control
    return named_controller(control, constants=constants if control in SETTABLE else None)


def _refuse(
    envs: Sequence[MultiAgentVectorEnv], controls: Sequence[str], constants: Mapping[str, float] | None
) -> None:
    """Raise what ``simulate_alternatives`` raises of scenarios and controllers that exist."""
    for kind, names in (("scenario", [env.network.scenario_name for env in envs]), ("control", controls)):
        if not names:
            raise CirlError(f"no {kind} is given")
        for name in names:
            if names.count(name) > 1:
                raise CirlError(f"{kind} '{name}' is given {names.count(name)} times")
    if constants and not set(controls) & set(SETTABLE):
        raise CirlError(f"values of single agents go with {' or '.join(SETTABLE)}, not with {', '.join(controls)}")
    for env in envs[1:]:
        if obstacles := list(_obstacles(envs[0].network, env.network)):
            pair = f"'{envs[0].network.scenario_name}' and '{env.network.scenario_name}'"
            name = env.network.name
            raise CirlError(f"network '{name}': scenarios {pair} cannot be compared: {'; '.join(obstacles)}")


def _obstacles(first: Network, second: Network) -> Iterator[str]:
    """Yield what keeps episodes of two scenarios from being compared, with the values of both."""
    units = {"mass": (first.mass_unit, second.mass_unit), "time": (first.time_unit, second.time_unit)}
    for quantity, (value_1, value_2) in units.items():
        if value_1 != value_2:
            yield f"unit of {quantity} {value_1} and {value_2}"
    if first.time_unit != second.time_unit:
        return  # times would differ even where they are the same
    intervals = (first.objective.reference_interval, second.objective.reference_interval)
    if intervals[0] != intervals[1]:
        yield f"reference interval of λ {intervals[0]:g} and {intervals[1]:g} {first.time_unit}"
    episode_1, episode_2 = first.episode, second.episode
    if episode_1.start != episode_2.start:
        yield f"start on the calendar {episode_1.start or 'none'} and {episode_2.start or 'none'}"
    if not math.isclose(episode_1.horizon * episode_1.control_interval, episode_2.horizon * episode_2.control_interval):
        lengths = [f"{x.horizon} intervals of {x.control_interval:g} {first.time_unit}" for x in (episode_1, episode_2)]
        advice = "; give a number of steps for both" if episode_1.control_interval == episode_2.control_interval else ""
        yield f"horizon {' and '.join(lengths)}{advice}"
