"""The parts of a network as they are given: what checks look at, and what a ``Network`` adds its arrays to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cirl_marl.network.elements import Account, Arc, Episode, Node, Objective, Observation, Service, Substance
from cirl_marl.network.rowsum import Floats
from cirl_marl.network.series import Series, Value


@dataclass(frozen=True, kw_only=True)
class Specification:
    """What a network under one scenario is made of, before anything is known to be wrong with it.

    Attributes:
        name: name in the catalogue, or of the definition file.
        nodes: compartments between arcs; of a ``Network`` those that hold a stock come first, in the order of every
            stock array.
        arcs: compartments with a flow, in the order of every flow array.
        services: what the network owes its users.
        accounts: what is counted beside mass: money, emissions, energy.
        substances: what the material has in it, beside all else.
        episode: time and solver.
        objective: circularity and rewards.
        observation: default observation.
        uncertain: how numbers spread that are not known exactly, by their path, such as ``arcs.mining.rate``.
        disturbances: processes in time that nobody foresees, by name.
        disturbed: numbers that they disturb, by their path.
        correlation: what correlates them; None if nothing does.
        default_agents: compartments that act by default; empty means every compartment with a control.
        mass_unit: unit of stocks.
        time_unit: unit of time.
        title: one line for tables.
        material: the target material.
        references: where its numbers come from, as a whole.
        source: definition file that it was read from; None if it was built in Python.
        source_sha256: hash of that file as it was then.
        data_sha256: hashes of the data files that the definition names, likewise, by the names that it gives them.
        region: the one of the regions of the definition that this is; empty if it has none.
        copies: ids of the nodes of each copy in it, by region, if it has copies of another definition.
        scenario_name: the scenario that this network describes.
        scenarios: the other scenarios of the same definition, by name.
        is_variant: whether it is what another network is under other options, or in a draw; limits of contents that the
            other could keep are no mistakes of such a one, nor are rates and demands that a draw takes to 0.
    """

    name: str
    nodes: tuple[Node, ...]
    arcs: tuple[Arc, ...]
    services: tuple[Service, ...] = ()
    accounts: tuple[Account, ...] = ()
    substances: tuple[Substance, ...] = ()
    episode: Episode = field(default_factory=Episode)
    objective: Objective = field(default_factory=Objective)
    observation: Observation = field(default_factory=Observation)
    uncertain: Mapping[str, Any] = field(default_factory=dict)
    disturbances: Mapping[str, Any] = field(default_factory=dict)
    disturbed: Mapping[str, Any] = field(default_factory=dict)
    correlation: Any = None
    default_agents: tuple[str, ...] = ()
    mass_unit: str = "kg"
    time_unit: str = "day"
    title: str = ""
    material: str = "not stated"
    references: tuple[str, ...] = ()
    source: Path | None = field(default=None, repr=False, compare=False)
    source_sha256: str | None = field(default=None, repr=False, compare=False)
    data_sha256: Mapping[str, str] = field(default_factory=dict, repr=False, compare=False)
    region: str = field(default="", compare=False)
    copies: Mapping[str, tuple[str, ...]] = field(default_factory=dict, repr=False, compare=False)
    scenario_name: str = "default"
    scenarios: Mapping[str, Any] = field(default_factory=dict, repr=False, compare=False)
    is_variant: bool = field(default=False, repr=False, compare=False)

    @property
    def address(self) -> str:
        """What loads it again: its definition file, with the region if there is one; empty if it has no file."""
        return "" if self.source is None else ":".join(filter(None, (str(self.source), self.region)))

    def original(self, id_: str) -> str:
        """Return the compartment that one stands for: itself, unless it is the copy of one for a substance."""
        return id_

    def components_of(self, id_: str) -> tuple[str, ...]:
        """Return the compartments that stand for one: itself, and its copies for substances if there are any."""
        return (id_,)

    def interval_means(self, value: Value) -> Floats:
        """Return a value in each control interval, its mean over the interval, shape (horizon,)."""
        horizon = self.episode.horizon
        if not isinstance(value, Series):
            return _constant(value, horizon)
        # many parts ask for the same series; the cache holds it, so that no other can get its id
        if id(value) not in self._series_means:
            self._series_means[id(value)] = value, _means(value, horizon, self.episode.control_interval)
        return self._series_means[id(value)][1]

    @cached_property
    def _series_means(self) -> dict[int, tuple[Series, Floats]]:
        return {}


def _constant(value: float, horizon: int) -> Floats:
    """Return what ``np.broadcast_to`` does, which takes several times as long for one number."""
    constant: Floats = np.ndarray(horizon, np.float64, np.array(value, dtype=np.float64), 0, (0,))
    constant.flags.writeable = False
    return constant


@lru_cache(maxsize=4096)  # scenarios share most of their series
def _means(series: Series, horizon: int, interval: float) -> Floats:
    means = series.means(np.arange(horizon + 1, dtype=np.float64) * interval)
    means.flags.writeable = False
    return means
