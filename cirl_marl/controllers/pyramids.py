"""How old what is in use is: age pyramids and mean ages of an episode, from what entered and when."""

from __future__ import annotations

from functools import cache
from typing import Annotated

import numpy as np

from cirl_marl.controllers.rollout import Rollout
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import Node
from cirl_marl.network.initial_ages import past_inflows, propagator, slots
from cirl_marl.network.lifetimes import Chain

OLD = 1e-4
"""Share that is left of what is too old to be told apart."""
MOST = 2_000
"""Largest number of ages that are."""


@positional_record
class Pyramid:
    """The ages of what is in use in a node, by the control interval in which it entered."""

    node: Annotated[str, "id of the node"]
    interval: Annotated[float, "length of a control interval, time"]
    mass: Annotated[Floats, "by age, at the start and after each interval, shape (steps + 1, ages), mass"]

    @property
    def ages(self) -> Floats:
        """Mean age of each class, shape (ages,), time; what enters is spread evenly over its interval."""
        return self.interval * np.arange(0.5, self.mass.shape[1])

    @property
    def mean_age(self) -> Floats:
        """At the start and after each interval, shape (steps + 1,), time; NaN of an empty stock."""
        total = self.mass.sum(axis=1)
        return np.asarray(np.divide(self.mass @ self.ages, total, out=np.full(len(total), np.nan), where=total > 0))


def pyramids(network: Network, run: Rollout) -> list[Pyramid]:
    """Return the pyramid of every node with a lifetime in the first copy of an episode.

    Ages at the start are those of history or growth.
    """
    interval, start, result = network.episode.control_interval, run.start, []
    for place, node in enumerate(network.stores):
        if node.lifetime is None:
            continue
        inflow = run.flow[:, network.recipients == place].sum(axis=1)
        chain, stretch = node.lifetime.chain, network.interval_means(node.stretch)
        if node.control is not None:
            stretch = stretch * run.controls[:, network.control_rows[node.id].start]
        if chain is None:
            mass = _of_line(node, interval, inflow, start[place])
        else:
            mass = _of_chain(node, chain, interval, inflow, start[place], stretch)
        result.append(Pyramid(node.id, interval, mass))
    return result


def _of_line(node: Node, interval: float, inflow: Floats, start: float) -> Floats:
    assert node.lifetime is not None
    count = slots(node.lifetime, interval)
    past = past_inflows(node, interval, count)
    cohorts = np.concatenate([(past * start / past.sum())[::-1], inflow * interval])
    return np.array([cohorts[step : step + count][::-1] for step in range(len(inflow) + 1)])


def _of_chain(node: Node, chain: Chain, interval: float, inflow: Floats, start: float, stretch: Floats) -> Floats:
    """Follow what entered in each interval through the stages."""
    assert node.lifetime is not None
    mean = node.lifetime.mean

    @cache
    def transition(factor: float) -> tuple[Floats, Floats]:
        return propagator(chain, interval / (mean * factor))

    count = _age_classes(chain, interval / mean / max(1.0, node.history_stretch, float(stretch.max())))
    survival, entry = transition(node.history_stretch)
    stages, cohorts = entry, np.zeros((chain.stages, count))
    for age, mass in enumerate(past_inflows(node, interval, count)):
        cohorts[:, age] = stages * mass
        stages = survival @ stages
    cohorts *= start / cohorts.sum()
    masses = [cohorts.sum(axis=0)]
    for flow, factor in zip(inflow, stretch.tolist(), strict=True):
        survival, entry = transition(factor)
        cohorts = survival @ cohorts
        # what is too old to be told apart stays in the last class
        oldest = cohorts[:, -1] + cohorts[:, -2] if count > 1 else cohorts[:, -1]
        cohorts = np.concatenate([(entry * flow * mean * factor)[:, None], cohorts[:, :-2], oldest[:, None]], axis=1)
        masses.append(cohorts.sum(axis=0))
    return np.array(masses)


def _age_classes(chain: Chain, interval: float) -> int:
    """Return the number of intervals, in lifetimes, until next to nothing is left."""
    empty = np.flatnonzero(chain.survival(interval * np.arange(2, MOST + 1)) < OLD)
    return int(empty[0]) + 2 if len(empty) else MOST
