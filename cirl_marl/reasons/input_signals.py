"""What agents see, with the units of what it stands for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np

from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.learners.views import View
from cirl_marl.network import Integers, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import Arc, Law, Node

TIME = "time"


@positional_record
class Signal:
    """An entry of observations."""

    name: Annotated[str, "as ``MultiAgentVectorEnv.observation_names`` has it"]
    about: Annotated[str, "the compartment that it is about; empty for time, services and what models show"]
    scale: Annotated[float, "what it is multiplied by to be in its unit"]
    unit: Annotated[str, "of what it stands for"]


def signal_of(network: Network, name: str) -> Signal:
    """Return what an entry of an observation stands for.

    Observations are divided by the scale of their compartment; time is a share of the episode.
    """
    if name == TIME:
        return Signal(name, "", network.episode.horizon * network.episode.control_interval, network.time_unit)
    kind, _, about = name.rpartition(" on " if name.startswith("mass on ") else " of ")
    compartment = network.compartments.get(about)
    if compartment is None:
        return Signal(name, "", 1.0, "1")
    scale, rate = compartment.scale, f"{network.mass_unit}/{network.time_unit}"
    is_batch = isinstance(compartment, Arc) and compartment.law is Law.BATCH
    if kind == "flow" and is_batch:  # what it delivers in an interval is shown as a mass
        return Signal(name, about, scale / network.episode.control_interval, rate)
    stores = isinstance(compartment, Node) and compartment.stores
    return Signal(name, about, scale, network.mass_unit if stores or is_batch else rate)


@positional_record
class PolicyColumns:
    """What stands in the row that a policy sees when it acts for one agent."""

    names: Annotated[tuple[str, ...], "of the signals that stand in it, each once"]
    places: Annotated[tuple[Integers, ...], "for each of them the columns of the row"]
    sources: Annotated[
        tuple[tuple[str, int], ...],
        "for each of them an agent, and an entry of its observation, where it is found first",
    ]
    entries: Annotated[Integers, "columns of the policy's output that are the agent's action"]


def policy_columns(env: MultiAgentVectorEnv, view: View, agent: str) -> PolicyColumns:
    """Return what stands where in the row in which a policy sees an agent.

    Views are asked: they are shown numbers that no indicator and no padding has.
    """
    first, codes, sources = 2, {}, list[tuple[str, int]]()
    for member in view.agents:
        count = len(env.observation_names[member])
        codes[member] = np.arange(first, first + count, dtype=np.float64)[None]
        sources += [(member, entry) for entry in range(count)]
        first += count
    rows = np.asarray(view.rows(codes), dtype=np.float64)
    row = rows[view.row_agents.index(agent)] if view.row_agents else rows[0]
    places: dict[str, list[int]] = {}
    entries: dict[str, tuple[str, int]] = {}
    for column, code in enumerate(row.astype(int).tolist()):
        if code >= 2:
            member, entry = sources[code - 2]
            name = env.observation_names[member][entry]
            places.setdefault(name, []).append(column)
            entries.setdefault(name, (member, entry))
    outputs = int(view.action_space.shape[0])  # type: ignore[index]
    actions = view.act(np.tile(np.arange(outputs, dtype=np.float64), (max(1, len(view.row_agents)), 1)))
    columns = tuple(np.array(place, dtype=np.intp) for place in places.values())
    return PolicyColumns(tuple(places), columns, tuple(entries.values()), np.asarray(actions[agent][0], dtype=np.intp))


def observation_entries(env: MultiAgentVectorEnv, agent: str, names: Sequence[str]) -> Integers:
    """Return which entries of an agent's observation have these names."""
    return np.flatnonzero([name in names for name in env.observation_names[agent]])
