"""What a policy or controller does in one episode, as a table of its actions in physical units over time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cirl_marl.controllers.basic import Controller, Neutral
from cirl_marl.controllers.outcome import outcome_lines, totals_text
from cirl_marl.controllers.rollout import EpisodeStart, Rollout, episode_start, interval_ends
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Network
from cirl_marl.network.calendar import labels
from cirl_marl.network.elements import ControlKind, Law
from cirl_marl.records.files import write_table


@dataclass(frozen=True, slots=True)
class Schedule:
    """One episode: the network, a header with units, columns of shape (columns, steps), its start, and the rollout.

    ``usual`` is what becomes of the same start if nobody acts, ``agents`` are those who do. ``control`` names who acts,
    empty for learnt policies; ``note`` is what has to be said beside the figures,
    ``proof`` what no episode from this start can exceed, and how far this one stays below it.
    """

    network: Network
    header: tuple[str, ...]
    columns: Floats
    episode_start: EpisodeStart
    rollout: Rollout
    usual: Rollout
    agents: tuple[str, ...]
    control: str = ""
    note: str = ""
    proof: str = ""

    def __str__(self) -> str:
        """Say where the episode begins, what comes of it, and what business as usual would have come to."""
        usual = f"λ̄ = {float(self.usual.episode_circularity[0]):.5g} {self.network.mass_unit}"
        usual += f", service level {float(self.usual.episode_service[0]):.4f}"
        if self.network.accounts:
            usual += f", {totals_text(self.network, self.usual)}"
        lines = [*outcome_lines(self.network, self.rollout, self.episode_start), f"as usual: {usual}"]
        return "\n".join([*lines, *filter(None, (self.proof, self.note))])

    def write(self, path: Path) -> None:
        """Write a CSV file, whole or not at all; a ``CirlError`` says so if its folder is not there.

        Of a network with a start on the calendar it has a further column, the year or date on which an interval begins.
        """
        if not path.parent.is_dir():
            raise CirlError(f"{path}: the folder {path.parent} does not exist")
        calendar, dates = labels(self.network, interval_ends(self.network) - self.network.episode.control_interval)
        texts = [[f"{value:.10g}" for value in column] for column in self.columns]
        header = (*self.header[:2], *(f"{label} at the start" for label in calendar), *self.header[2:])
        rows = zip(*texts[:2], *dates, *texts[2:], strict=True)
        write_table(path, header, rows)


def schedule(
    env: MultiAgentVectorEnv,
    controller: Controller,
    *,
    seed: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Schedule:
    """Run one episode and tabulate it, a row for each control interval.

    Columns are when the interval begins and ends, the value of every control in it, the mass that an agent with a valve
    lets through, λ at its end and its mean over it, the service level, and stocks at its end.

    It begins at ``episode_start(env, seed)``. ``progress`` is called with the share that is done.

    Raises:
        CirlError: if the controller does not fit the network, nobody acts, or there are several copies.
    """
    network = env.network
    if env.num_envs != 1 or not env.agents:
        raise CirlError(f"network '{network.name}': a plan is of one copy in which somebody acts")
    origin = episode_start(env, seed)
    usual = origin.play(env, Neutral())
    run = origin.play(env, controller, progress=progress)
    values = run.controls[:, np.r_[tuple(network.control_rows[agent] for agent in env.agents)]].T
    ends = interval_ends(network)
    columns = [
        (f"from ({network.time_unit})", ends - network.episode.control_interval),
        (f"to ({network.time_unit})", ends),
        *zip(control_names(network, env.agents), values, strict=True),
        *_throughputs(network, env.agents, run.flow.T),
        (f"circularity at the end ({network.mass_unit})", run.circularity[0]),
        (f"mean circularity ({network.mass_unit})", run.circularity_mean[0]),
        ("service level (1)", run.service[0]),
        *((f"{a.id} ({a.unit})", amount) for a, amount in zip(network.accounts, run.bookings[0], strict=True)),
        *(
            (f"stock of {node.id} at the end ({network.mass_unit})", run.stock[:, i])
            for i, node in enumerate(network.stores)
        ),
    ]
    header, table = zip(*columns, strict=True)
    return Schedule(network, header, np.array(table), origin, run, usual, env.agents)


CONTROL_NAMES = {
    ControlKind.FLOW: "flow ordered ({flow_unit})",
    ControlKind.RATE: "valve factor (1)",
    ControlKind.SHARE: "share (1)",
    ControlKind.STRETCH: "lifetime factor (1)",
    ControlKind.TRANSFER: "share of {substances} (1)",
}
"""What an agent sets, by the kind of its control; inputs of models have names of their own, which end in their unit."""


def control_names(network: Network, agents: tuple[str, ...]) -> Iterator[str]:
    """Yield what each entry of the actions sets, with its unit."""
    flow_unit = f"{network.mass_unit}/{network.time_unit}"
    for agent in agents:
        control, model = network.compartments[agent].control, network.compartments[agent].model
        assert control is not None
        if control.kind in CONTROL_NAMES:
            substances = ", ".join(control.substances)
            yield f"{agent}: {CONTROL_NAMES[control.kind].format(flow_unit=flow_unit, substances=substances)}"
        elif model is not None:
            yield from (f"{agent}: {name}" for name in model.input_names)


def _throughputs(network: Network, agents: tuple[str, ...], flow: Floats) -> Iterator[tuple[str, Floats]]:
    """Yield what the agents let through, shape (steps,) each: an arc its flow, a node what leaves it but in batches."""
    unit = f"{network.mass_unit}/{network.time_unit}"
    steady = np.array([arc.law is not Law.BATCH for arc in network.arcs], dtype=bool)
    for agent in agents:
        if agent in network.arc_index:
            yield f"{agent}: flow ({unit})", flow[network.arc_index[agent]]
        elif (outflows := steady & (network.donors == network.node_index[agent])).any():
            yield f"{agent}: total outflow ({unit})", flow[outflows].sum(axis=0)
