"""What an environment is in, what it was in, and what one step brought."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from cirl_marl.errors import ControlError
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import with_field_docs


@with_field_docs
@dataclass(frozen=True, slots=True)
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

    @property
    def drawn(self) -> Floats | None:
        """The factors, None if none are drawn."""
        return self.factors if len(self.factors) else None

    def copied(self) -> State:
        """Return the state with arrays of its own."""
        return replace(self, **{each.name: getattr(self, each.name).copy() for each in fields(self)})

    def renewed(self, ended: NDArray[np.bool_], fresh: State) -> State:
        """Return the state in which the copies that ``ended``, shape (B,), are those of ``fresh``."""
        return State(*(np.where(ended, getattr(fresh, each.name), getattr(self, each.name)) for each in fields(self)))


@with_field_docs
@dataclass(frozen=True, slots=True)
class Snapshot:
    """Everything needed to go on from here, bit for bit."""

    state: Annotated[State, "the physical state"]
    streams: Annotated[tuple[Mapping[str, Any], ...], "state of the random stream of each copy"]
    agents: Annotated[tuple[str, ...], "who acts"]
    network: Annotated[Network, "what it is a snapshot of, under its scenario and horizon"]
    elapsed: Annotated[int, "the published step counter of a one-agent environment with ``legacy_episode``"] = 0

    def check(self, network: Network, copies: int, agents: tuple[str, ...], *, uncertain: bool) -> None:
        """Raise a ``ControlError`` unless ``copies`` of ``network``, in which ``agents`` act, can go back to this."""
        drawn = self.state.drawn is not None
        theirs = _described(self.network, len(self.streams), self.agents, drawn)
        ours = _described(network, copies, agents, uncertain)
        if theirs != ours:
            raise ControlError(f"the snapshot does not fit: it is of {theirs}; this is {ours}")
        if self.network != network:
            raise ControlError(f"the snapshot does not fit: it is of another definition of {ours}")


@with_field_docs
@dataclass(frozen=True, slots=True)
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
    truncated: Annotated[NDArray[np.bool_], "time limit reached, shape (B,)"]
    success: Annotated[Mapping[str, NDArray[np.bool_]], "whether the task of a compartment's model is done, shape (B,)"]

    def infos(self, agents: Sequence[str]) -> dict[str, dict[str, Any]]:
        """Return λ, local reward, flows (B, arcs) and service level for each agent; success where it is defined."""
        self.circularity.flags.writeable = self.service_level.flags.writeable = False  # the same for all agents
        team = {"circularity": self.circularity, "flows": self.flow.T, "service_level": self.service_level}
        infos = {agent: {**team, "local_reward": local} for agent, local in zip(agents, self.local, strict=True)}
        for agent in self.success.keys() & infos.keys():
            infos[agent]["success"] = self.success[agent]
        return infos


def _described(network: Network, copies: int, agents: tuple[str, ...], uncertain: bool) -> str:
    return (
        f"network '{network.name}', scenario '{network.scenario_name}', {network.episode.horizon} steps, "
        f"{copies} copies, agents {', '.join(agents)}{', uncertain' if uncertain else ''}"
    )
