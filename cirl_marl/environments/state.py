"""What an environment is in, what it was in, and what one step brought."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from cirl_marl.errors import ControlError
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import with_field_docs
from cirl_marl.network.processes import no_paths


@with_field_docs
@dataclass(slots=True)  # not frozen, which takes three times as long to make, in every step
class State:
    """The physical state of B environments, which observations follow from, and the sums that an episode reports."""

    stock: Annotated[Floats, "masses of nodes, then of batch arcs, then the unit row, shape (rows, B), mass"]
    inner: Annotated[Floats, "inner states of the compartments' models, shape (states, B)"]
    flow: Annotated[Floats, "mean flows of the last control interval, shape (arcs, B), mass/time"]
    measures: Annotated[Floats, "what the models measured at its end, under its controls, shape (measures, B)"]
    step: Annotated[Integers, "control intervals done, shape (B,)"]
    factors: Annotated[Floats, "drawn factors on the uncertain numbers, shape (numbers, B); no rows if none are drawn"]
    batched: Annotated[Floats, "m_fb of this episode, in two parts as in ``Network.circularity``, shape (2, B), mass"]
    circularity: Annotated[Floats, "sum over the episode of the interval means of λ, shape (B,), mass"]
    service: Annotated[Floats, "sum over the episode of the level of each service, shape (services, B)"]
    accounts: Annotated[Floats, "amounts booked in this episode, discounted, shape (accounts, B)"]
    substances: Annotated[
        Floats, "mean flow of each substance in the last interval, shape (substances · arcs, B), mass/time"
    ]
    processes: Annotated[
        Floats, "states of the disturbances in all intervals of the episode and the one after, (intervals, names, B)"
    ] = field(default_factory=no_paths)
    disturbances: Annotated[Floats, "their values, likewise; what agents do does not change them"] = field(
        default_factory=no_paths
    )

    def copy(self) -> State:
        """Return the state with arrays of its own."""
        return State(*(getattr(self, part.name).copy() for part in fields(self)))

    def without_future(self) -> State:
        """Return the state without what disturbances will be: NaN in the intervals after the coming one."""
        later = np.arange(len(self.processes))[:, None, None] > self.step
        processes, values = (np.where(later, np.nan, paths) for paths in (self.processes, self.disturbances))
        return replace(self, processes=processes, disturbances=values)

    def replace(self, copies: NDArray[np.bool_], state: State) -> State:
        """Return the state in which some ``copies``, shape (B,), are those of another ``state``."""
        return State(*(np.where(copies, getattr(state, part.name), getattr(self, part.name)) for part in fields(self)))


@with_field_docs
@dataclass(frozen=True, slots=True)
class Snapshot:
    """Everything needed to go on from here, bit for bit."""

    state: Annotated[State, "the physical state"]
    streams: Annotated[
        tuple[Mapping[str, Any], ...], "states of the random streams: that of each copy, then those of its disturbances"
    ]
    agents: Annotated[tuple[str, ...], "who acts"]
    network: Annotated[Network, "what it is a snapshot of, under its scenario and horizon"]
    legacy_steps: Annotated[int, "the published step counter of a one-agent environment with ``legacy_episode``"] = 0

    def check(self, network: Network, copies: int, agents: tuple[str, ...], *, uncertain: bool) -> None:
        """Raise a ``ControlError`` unless ``copies`` of ``network``, in which ``agents`` act, can go back to this."""
        source = _description(self.network, len(self.state.step), self.agents, len(self.state.factors) > 0)
        target = _description(network, copies, agents, uncertain)
        if source != target:
            raise ControlError(f"the snapshot does not fit: it is of {source}; this is {target}")
        if self.network != network:
            raise ControlError(f"the snapshot does not fit: it is of another definition of {target}")


@with_field_docs
@dataclass(slots=True)  # not frozen, which takes three times as long to make, in every step
class Outcome:
    """What one control interval brought, agents stacked along axis 0."""

    observation: Annotated[NDArray[np.float32], "shape (entries of all agents, B), float32"]
    reward: Annotated[Floats, "shape (agents, B)"]
    local: Annotated[Floats, "local rewards, shape (agents, B)"]
    circularity: Annotated[Floats, "λ at the end of the interval, shape (B,), mass"]
    circularity_mean: Annotated[Floats, "mean of λ over the interval, shape (B,), mass"]
    levels: Annotated[Floats, "level of each service, shape (services, B)"]
    service_level: Annotated[Floats, "their mean, shape (B,); 1 without services"]
    flow: Annotated[Floats, "mean flows, shape (arcs, B), mass/time"]
    entries: Annotated[Floats, "amount of each entry of the ledger, not discounted, shape (entries, B)"]
    bookings: Annotated[Floats, "amounts booked on accounts, not discounted, shape (accounts, B)"]
    truncated: Annotated[NDArray[np.bool_], "time limit reached, shape (B,)"]
    success: Annotated[Mapping[str, NDArray[np.bool_]], "whether the task of a compartment's model is done, shape (B,)"]


@with_field_docs
@dataclass(slots=True)
class Interval:
    """The last control interval, from which its derivatives follow."""

    before: Annotated[State, "the state at its start"]
    after: Annotated[State, "the state at its end, before copies whose episode is over start anew"]
    actions: Annotated[Floats, "stacked actions, shape (entries, B)"]
    controls: Annotated[Floats, "controls with what supplies made up for, shape (controls, B)"]


def _description(network: Network, copies: int, agents: tuple[str, ...], uncertain: bool) -> str:
    return (
        f"network '{network.name}', scenario '{network.scenario_name}', {network.episode.horizon} steps, "
        f"{copies} copies, agents {', '.join(agents)}{', uncertain' if uncertain else ''}"
    )
