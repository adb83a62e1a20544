"""From the normalised actions of agents to the physical controls of a network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from cirl_marl.dynamics.uncertain_factors import ControlFactors, RowFactors, capacity_numbers
from cirl_marl.errors import CirlError, ControlError, unknown_name
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.rowsum import single_column, spans

ROUNDING = 1e-12
"""Part of its largest value by which a control that is neutral may miss that, by the rounding of its action."""
BOUND = 1.0 + 1e-6
"""Largest action taken: wrappers that rescale actions do so in single precision and may land a rounding beyond 1."""


class Actuators:
    """Checks actions and maps them linearly from [−1, 1] to the bounds of the controls.

    Attributes:
        agents: compartments that act, in the order of every stacked array.
        entries: rows of each agent's action in a stacked action.
        control_rows: row of each entry of a stacked action among all controls, shape (entries,).
        spaces: action space of each agent.
    """

    def __init__(
        self,
        network: Network,
        agents: Sequence[str] | None,
        num_envs: int,
        ranges: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    ) -> None:
        """Let ``agents`` act, None being the network's own choice; a ``CirlError`` names one unknown or named twice.

        ``ranges`` are those of the factors on what is uncertain or disturbed, which ``step`` and others then bring.
        """
        self.agents = _acting_agents(network, agents)
        self.num_envs = num_envs
        rows = {agent: network.control_rows[agent] for agent in self.agents}
        self.entries = dict(zip(rows, spans(span.stop - span.start for span in rows.values()), strict=True))
        control_rows = [row for span in rows.values() for row in range(span.start, span.stop)]
        self.control_rows: Integers = np.array(control_rows, dtype=np.intp)
        self.spaces = {a: Box(-1.0, 1.0, (span.stop - span.start,), np.float32) for a, span in rows.items()}
        self._all_act = control_rows == list(range(network.control_bounds.shape[1]))
        self._drawn = ControlFactors(network, ranges, self.control_rows)
        self._all_drawn = ControlFactors(network, ranges)
        low, neutral, high = (single_column(bound) for bound in network.control_bounds)
        sizes = np.maximum(abs(low), abs(high)).max(axis=1, initial=0.0, keepdims=True)
        self._rounding: Floats = ROUNDING * sizes
        capacities, highest = capacity_numbers(network, ranges), high
        self._all_capacities = RowFactors(capacities)
        self._capacities = RowFactors(
            {entry: capacities[row] for entry, row in enumerate(control_rows) if row in capacities}
        )
        low, high = low[self.control_rows], high[self.control_rows]
        tables: tuple[Floats, ...] = (low, (high + low) / 2, (high - low) / 2, high, neutral, highest)
        self._vary_in_time = any(bool((table != table[:, :1]).any()) for table in tables)
        # one value per copy: NumPy takes equal shapes about twice as fast as it broadcasts a column
        first = np.zeros(num_envs, dtype=np.intp)
        if not self._vary_in_time:
            tables = tuple(table.take(first, axis=1) for table in tables)
        *self._bounds, self._neutral, self._highest = tables

    def neutral_action(self, step: Integers, factors: Floats | None = None) -> dict[str, Floats]:
        """Normalised action of each agent that leaves it neutral, shape (B, entries) each, in an interval of each."""
        _, middle, half, _ = self._bounds_in(step, factors)
        neutral = self._neutral_in(step, factors)
        distance = neutral[self.control_rows] - middle
        neutral = np.divide(distance, half, out=np.zeros_like(distance), where=half > 0)
        np.clip(neutral, -1.0, 1.0, out=neutral)  # rounding may lead beyond a bound
        return self.unstack(neutral)

    def normalise(self, agent: str, values: Floats, step: Integers, factors: Floats | None = None) -> Floats:
        """Return the actions that come closest to physical values of an agent's control, shape (its entries, B)."""
        _, middle, half, _ = (table[self.entries[agent]] for table in self._bounds_in(step, factors))
        actions: Floats = np.divide(values - middle, half, out=np.zeros_like(values), where=half > 0)
        return np.clip(actions, -1.0, 1.0)

    def stack(self, actions: Mapping[str, ArrayLike]) -> Floats:
        """Stack the actions of all agents, shape (entries, B); the checks of ``step`` apply."""
        if not isinstance(actions, Mapping):
            raise ControlError(f"actions must be a mapping agent → action, not {actions!r}")
        joint = np.empty((len(self.control_rows), self.num_envs))
        if len(actions) != len(self.agents):
            raise ControlError(self._wrong_agents(actions))
        for agent, entries in self.entries.items():
            if agent not in actions:
                raise ControlError(self._wrong_agents(actions))
            action = action_array(f"action of agent '{agent}'", actions[agent])
            shape = (self.num_envs, entries.stop - entries.start)
            if action.shape != shape:
                raise ControlError(wrong_shape(agent, action.shape, shape))
            if action.dtype.kind not in "biuf":
                raise ControlError(f"action of agent '{agent}' is {actions[agent]!r}; it must hold numbers in [-1, 1]")
            joint[entries] = action.T
        return joint

    def unstack(self, actions: Floats) -> dict[str, Floats]:
        """Split stacked actions, shape (entries, B), into agent → (B, entries of its action)."""
        return {agent: actions[entries].T for agent, entries in self.entries.items()}

    def controls(self, actions: Floats, step: Integers, factors: Floats | None = None) -> Floats:
        """Map stacked actions, (entries, B), to physical values of every control, (controls, B), or refuse them.

        ``step``, shape (B,), is the index of the control interval in each copy, and ``factors``, shape (numbers, B),
        are those on what is disturbed there.
        """
        if not (actions.max(initial=0.0) <= BOUND and actions.min(initial=0.0) >= -BOUND):
            raise ControlError(self._wrong_values(actions))
        low, middle, half, high = self._bounds_in(step, factors)
        values = actions * half
        values += middle
        np.maximum(values, low, out=values)  # with bounds that are arrays, clip is slower
        np.minimum(values, high, out=values)
        if self._all_act:
            return values
        controls = self._neutral_in(step, factors).copy()
        controls[self.control_rows] = values
        return controls

    def deviation(self, controls: Floats, step: Integers, factors: Floats | None = None) -> Floats:
        """Return by how much controls are away from their neutral values, but for rounding, shape (controls, B)."""
        difference = controls - self._neutral_in(step, factors)
        return np.where(np.abs(difference) <= self._rounding, 0.0, difference)

    def pull_back(
        self, actions: Floats, step: Integers, factors: Floats | None, adjoint: Floats
    ) -> tuple[Floats, Floats]:
        """Return derivatives of ``controls`` by actions, and by low, neutral and high values of all controls.

        Of a functional whose derivatives by the controls, (controls, B), are the ``adjoint``; shapes are (entries, B)
        and (3, controls, B). At a bound that of an action is the derivative from within.
        """
        _, _, half, _ = self._bounds_in(step, factors)
        ends, own = np.zeros((3, *adjoint.shape)), adjoint[self.control_rows]
        ends[1] = adjoint
        ends[0, self.control_rows], ends[2, self.control_rows] = own * (1.0 - actions) / 2, own * (1.0 + actions) / 2
        ends[1, self.control_rows] = 0.0
        return own * half, ends

    def _bounds_in(self, step: Integers, factors: Floats | None) -> Sequence[Floats]:
        """Return low, middle, half of the range and high of the agents' controls, shape (entries, B) each."""
        bounds = tuple(table.take(step, axis=1) for table in self._bounds) if self._vary_in_time else self._bounds
        if factors is None or not (len(self._capacities.rows) or self._drawn.is_active):
            return bounds
        low, high = self._drawn(bounds[0], factors), self._capacities(self._drawn(bounds[3], factors), factors)
        return low, (high + low) / 2, (high - low) / 2, high

    def _neutral_in(self, step: Integers, factors: Floats | None) -> Floats:
        """Return the values of all controls while nobody acts, shape (controls, B): at most their capacity."""
        tables = self._neutral, self._highest
        neutral, highest = (table.take(step, axis=1) for table in tables) if self._vary_in_time else tables
        neutral = self._all_drawn(neutral, factors)
        if factors is None or not len(self._all_capacities.rows):
            return neutral
        return np.minimum(neutral, self._all_capacities(self._all_drawn(highest, factors), factors))

    def _wrong_agents(self, actions: Mapping[str, object]) -> str:
        for agent in actions:
            if agent not in self.agents:
                return f"actions: {unknown_name('agent', agent, self.agents)}"
        return f"actions are missing for {[agent for agent in self.agents if agent not in actions]}"

    def _wrong_values(self, actions: Floats) -> str:
        wrong = ~((actions >= -BOUND) & (actions <= BOUND))  # NaN too
        entry, copy_ = np.argwhere(wrong)[0]
        agent = next(agent for agent, entries in self.entries.items() if entries.start <= entry < entries.stop)
        return f"action of agent '{agent}' in copy {copy_} is {actions[entry, copy_]}; it must be a number in [-1, 1]"


def planned_deviation(network: Network, agents: Sequence[str], actions: Floats, first: int = 0) -> Floats:
    """Return by how much controls are away from their neutral values under planned actions, (controls, intervals).

    Args:
        network: certain.
        agents: who acts; none stands for the network's own choice.
        actions: stacked, shape (intervals, entries).
        first: the interval in which they begin.
    """
    steps = np.arange(first, first + len(actions))
    actuators = Actuators(network, agents or None, len(actions))
    return actuators.deviation(actuators.controls(np.ascontiguousarray(actions.T), steps), steps)


def action_array(subject: str, action: ArrayLike) -> NDArray[Any]:
    """Return actions of an agent, or of all, as an array; messages begin with the ``subject``.

    Raises:
        ControlError: for what is no array, such as a tensor that requires a gradient, and for masked entries.
    """
    if isinstance(action, np.ma.MaskedArray) and np.ma.is_masked(action):
        raise ControlError(f"{subject} is masked in part; it must hold numbers in [-1, 1]")
    try:
        return np.asarray(action)
    except (RuntimeError, TypeError, ValueError) as error:
        reason = str(error).split("\n")[0]
        raise ControlError(f"{subject} is no array of numbers: {reason}") from error


def wrong_shape(agent: str, shape: tuple[int, ...], space_shape: tuple[int, ...]) -> str:
    """Say that an agent's action has another shape than it should have."""
    return f"action of agent '{agent}' has shape {shape}, expected {space_shape}"


def _acting_agents(network: Network, agents: Sequence[str] | None) -> tuple[str, ...]:
    if agents is None:
        ids = network.agents
    elif isinstance(agents, str) or not isinstance(agents, Sequence) or not all(isinstance(a, str) for a in agents):
        raise CirlError(f"agents must be a sequence of ids in a fixed order, such as a list, not {agents!r}")
    else:
        ids = tuple(agents)
    for agent in ids:
        if agent in network.compartments and agent not in network.control_rows:
            raise CirlError(f"network '{network.name}': '{agent}' has no control, so that it cannot act")
        if agent not in network.control_rows:
            raise CirlError(f"network '{network.name}': {unknown_name('agent', agent, network.controllable)}")
    if (network.agents and not ids) or len(set(ids)) != len(ids):
        raise CirlError(f"network '{network.name}': agents {list(ids)} must be distinct and at least one")
    return ids
