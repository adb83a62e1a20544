"""Where episodes start: drawn from one random stream per copy, or given by the caller; and what will disturb them."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.errors import ControlError, check_names, unknown_name
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.compartment_model import DiscreteTimeModel, GoalTask
from cirl_marl.network.processes import Paths, disturbance_stream
from cirl_marl.network.substances import CONTENT, changing_sources
from cirl_marl.network.uncertainty import numbers_of


class Starts:
    """Initial stocks and inner states of B copies, each with a random stream of its own.

    Attributes:
        names: nodes, ``node.stage_i`` of those with a lifetime, then ``compartment.state`` of the inner states; the
            rows of every array here.
        streams: one generator per copy.
        disturbance_streams: another one, if something is disturbed; starts are the same without it.
    """

    def __init__(self, network: Network, dynamics: Dynamics, num_envs: int, order: Sequence[str]) -> None:
        """Compile the initial ranges of B = ``num_envs`` copies; the streams are seeded from the operating system.

        ``order`` names the rows that an array of initial values gives; it is empty if only mappings are taken.
        """
        rows, inner = dynamics.rows, dynamics.inner
        self.names = rows.start_names
        self.streams = [np.random.default_rng() for _ in range(num_envs)]
        self.processes = network.processes
        self.disturbance_streams = self._disturbance_streams([None] * num_envs)
        self._network, self._bounds, self._wholes = network, _bounds(network), _wholes(network)
        self._rows = {name: np.array([row]) for row, name in enumerate(self.names)}
        ids = {i: network.stores[i].id for i in rows.stages}
        self._stages = {id_: rows.stages[i] for i, id_ in ids.items()}
        self._rows |= self._stages
        self._spread = {id_: network.start_shares(network.stores[i]) for i, id_ in ids.items()}
        self._components, substances = rows.components, [substance.id for substance in network.substances]
        reserves = {node.id for node in changing_sources(network)}  # which do for all that may be
        self._uncertain_contents = [
            (part, {id_: row for id_, row in numbers.items() if id_ not in reserves})
            for part, substance in enumerate(substances, start=1)
            for numbers in [numbers_of(network.uncertain, "nodes", f"{CONTENT}{substance}")]
        ]
        inseparable = {name for names in self._wholes.values() for name in names}
        self._array_order = () if inseparable & set(order) else tuple(order)
        self._physical, self._stocks, self._inner = dynamics.physical, rows.nodes.stop, inner
        stores = len(network.stores)
        self._uniform = np.concatenate([np.arange(stores), self._stocks + inner.range_rows])
        self._of_models = np.setdiff1d(np.arange(self._stocks, len(self.names)), self._uniform)
        self._spreads = tuple(network.uncertain.values())
        self._low = np.concatenate([network.initial[0], inner.low])
        self._width = np.concatenate([network.initial[1], inner.high]) - self._low

    @property
    def are_random(self) -> bool:
        """Whether two copies can begin differently, or be disturbed by other values."""
        return bool(self._width.any() or len(self._of_models) or self.processes.names)

    def begin(
        self, seed: int | Sequence[int] | None, options: Mapping[str, Any] | None, *, uncertain: bool
    ) -> tuple[Floats, Floats]:
        """Return the state in which every copy starts, and what is drawn; see ``MultiAgentVectorEnv.reset``.

        Shapes are (rows, B) and (numbers, B), without numbers unless they are ``uncertain``.
        """
        seeds = None if seed is None else self._seeds(seed)
        initial_state = self._initial_state({} if options is None else options)
        if seeds is not None:  # not before, so that what is refused changes nothing
            self.streams = [np.random.default_rng(s) for s in seeds]
            self.disturbance_streams = self._disturbance_streams(seeds)
        start, factors = self.draw(range(len(self.streams)), uncertain=uncertain)
        for rows in self._stages.values():
            if any(self.names[row] in initial_state for row in rows):
                start[rows] = 0.0  # stages that are not given are empty
        for name, values in initial_state.items():
            start[self._rows[name]] = self._drawn_spread(name, factors) * values if name in self._spread else values
        return start, factors

    def draw(self, copies: Sequence[int] | range | Integers, *, uncertain: bool) -> tuple[Floats, Floats]:
        """Draw initial stocks and inner states of some copies, each from its own stream, and ``uncertain`` numbers.

        Models that draw their own start come first, so that a lone robot starts as it does in its own library. Shapes
        are (rows, len(copies)) and (numbers, len(copies)).
        """
        by_copy = np.empty((len(copies), len(self._low)))
        of_models = np.empty((len(self._of_models), len(copies)))
        for column, (row, i) in enumerate(zip(by_copy, copies, strict=True)):
            if len(of_models):
                of_models[:, column] = self._inner.start(self.streams[i])
            self.streams[i].random(out=row)
        uniform = np.ascontiguousarray(by_copy.T)
        uniform *= self._width[:, None]
        uniform += self._low[:, None]
        factors = self._factors(copies) if uncertain else np.empty((0, len(copies)))
        if len(uniform) == len(self.names):
            return uniform, factors
        start = np.empty((len(self.names), len(copies)))
        start[self._uniform], start[self._of_models] = uniform, of_models
        for id_, rows in self._stages.items():
            start[rows] = self._drawn_spread(id_, factors) * uniform[self._network.node_index[id_]]
        return start, factors

    def _drawn_spread(self, node: str, factors: Floats) -> Floats:
        """Return the part of a stock that is in each of its rows, with the contents that were drawn, (rows, 1 or B)."""
        spread = self._spread[node][:, None]
        entries = [(part, numbers[node]) for part, numbers in self._uncertain_contents if node in numbers]
        if not entries or not len(factors):
            return spread
        parts = np.repeat(spread, factors.shape[1], axis=1).reshape(self._components, -1, factors.shape[1])
        whole = parts.sum(axis=0)
        for part, number in entries:
            parts[part] *= factors[number]
        parts[0] = np.maximum(whole - parts[1:].sum(axis=0), 0.0)
        return parts.reshape(-1, factors.shape[1])

    def _factors(self, copies: Sequence[int] | range | Integers) -> Floats:
        """Draw factors on the uncertain numbers in some copies, each from its own stream, (numbers, len(copies))."""
        shares = np.array([self.streams[i].random(len(self._spreads)) for i in copies])
        shares = np.ascontiguousarray(shares.reshape(len(copies), len(self._spreads)).T)
        factors = [spread.at(share) for spread, share in zip(self._spreads, shares, strict=True)]
        return np.array(factors).reshape(shares.shape)

    def paths(self, copies: range | Integers) -> Paths:
        """Draw what will disturb an episode in some copies, each from its own stream."""
        return self.processes.paths([self.disturbance_streams[i] for i in copies] if self.disturbance_streams else ())

    def saved_streams(self) -> tuple[Mapping[str, Any], ...]:
        """Return a copy of the state of every stream."""
        streams = (*self.streams, *self.disturbance_streams)
        return tuple(copy.deepcopy(dict(stream.bit_generator.state)) for stream in streams)

    def restore_streams(self, states: Sequence[Mapping[str, Any]]) -> None:
        """Put every stream back."""
        for stream, state in zip((*self.streams, *self.disturbance_streams), states, strict=True):
            stream.bit_generator.state = copy.deepcopy(dict(state))

    def _disturbance_streams(self, seeds: Sequence[int | None]) -> list[np.random.Generator]:
        return [disturbance_stream(seed) for seed in seeds] if self.processes.names else []

    def _seeds(self, seed: int | Sequence[int]) -> list[int]:
        copies = len(self.streams)
        if isinstance(seed, int | np.integer) and not isinstance(seed, bool):
            seeds = [int(seed) + i for i in range(copies)]
        else:
            seeds = list(seed) if isinstance(seed, Sequence | np.ndarray) and np.ndim(seed) == 1 else []
        whole = all(isinstance(s, int | np.integer) and not isinstance(s, bool) and s >= 0 for s in seeds)
        if len(seeds) != copies or not whole:
            raise ControlError(f"seed {seed!r} must be a non-negative integer, or {copies} of them")
        return seeds

    def _initial_state(self, options: Mapping[str, Any]) -> dict[str, Floats]:
        """Return the given initial stocks and inner states by name."""
        if not isinstance(options, Mapping):
            raise ControlError(f"reset options must be a mapping, not {options!r}")
        for key in options:
            if key not in ("initial_state", "options"):  # PettingZoo's own test passes the key "options"
                raise ControlError(f"reset options: {unknown_name('option', key, ['initial_state'])}")
        state = options.get("initial_state", {})
        if not isinstance(state, Mapping):
            names = self._array_order
            values = float_array("initial_state", state)
            if not names or values.shape != (len(names),):
                raise ControlError(
                    f"initial_state has shape {values.shape}: give a mapping node → stock"
                    + (f", or the values of {', '.join(names)} in this order" if names else "")
                )
            state = dict(zip(names, values, strict=True))
        check_names("node or inner state", state, self._rows, "initial_state: ", ControlError)
        for id_, rows in self._stages.items():
            stages = [self.names[row] for row in rows if self.names[row] in state]
            if stages and id_ in state:
                raise ControlError(f"initial_state: '{id_}' and '{stages[0]}': give the stock, or its stages, not both")
        arrays = {id_: self._initial(id_, values) for id_, values in state.items()}
        for owner, whole in self._wholes.items():
            part = [name for name in whole if name in state]
            if part and len(part) < len(whole):
                raise ControlError(
                    f"initial_state of '{part[0]}': a start of '{owner}' is the state of its simulator, all "
                    f"{len(whole)} entries together; snapshot() and restore() go back to one"
                )
        if self._physical and arrays:
            self._check_mass(arrays)
        return arrays

    def _check_mass(self, initial_state: Mapping[str, Floats]) -> None:
        """Refuse more mass than the observation space covers; stages of which some are not given count as none."""
        network = self._network
        most = dict(zip((node.id for node in network.stores), network.initial[1], strict=True))
        stocks = {id_: initial_state.get(id_, stock) for id_, stock in most.items()}
        for id_, rows in self._stages.items():
            if parts := [initial_state[self.names[row]] for row in rows if self.names[row] in initial_state]:
                stocks[id_] = np.sum([np.broadcast_to(part, len(self.streams)) for part in parts], axis=0)
        limit = float(sum(most.values()))
        total = float(np.sum([np.broadcast_to(stock, len(self.streams)) for stock in stocks.values()], axis=0).max())
        if total > limit * (1 + 1e-9):
            raise ControlError(
                f"initial_state: {total:.6g} {network.mass_unit} in all, but the observation space of '{network.name}' "
                f"covers {limit:.6g}; widen the initial ranges of the definition"
            )

    def _initial(self, id_: str, values: ArrayLike) -> Floats:
        stock = float_array(f"initial_state of '{id_}'", values)
        if stock.shape not in ((), (len(self.streams),)):
            raise ControlError(f"initial_state of '{id_}' has shape {stock.shape}, not () or {(len(self.streams),)}")
        is_stock = self._physical and bool((self._rows[id_] < self._stocks).all())
        if not np.isfinite(stock).all() or (is_stock and (stock < 0).any()):
            raise ControlError(f"initial_state of '{id_}' is {values!r}: stocks are finite and not negative")
        low, high = self._bounds.get(id_, (-np.inf, np.inf))
        if (stock < low).any() or (stock > high).any():
            raise ControlError(f"initial_state of '{id_}' is {values!r}: its model holds for [{low:g}, {high:g}]")
        return stock


def _bounds(network: Network) -> dict[str, tuple[float, float]]:
    """Return the values of inner states for which their models hold, by ``compartment.state``."""
    return {
        f"{owner}.{name}": bounds
        for owner, compartment in network.compartments.items()
        if compartment.model is not None
        for name, bounds in compartment.model.bounds.items()
    }


def _wholes(network: Network) -> dict[str, tuple[str, ...]]:
    """Return the states that only make sense together: those of models that draw their start, but for their goals."""
    wholes = {}
    for owner, compartment in network.compartments.items():
        model = compartment.model
        if isinstance(model, DiscreteTimeModel):
            goals = model.desired_names if isinstance(model, GoalTask) else ()
            wholes[owner] = tuple(f"{owner}.{name}" for name in model.state_names if name not in goals)
    return wholes


def float_array(label: str, values: ArrayLike) -> Floats:
    """Return numbers as an array; a ``ControlError`` says by their ``label`` that they are something else."""
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "iuf" or np.ma.is_masked(values):
            raise ValueError("no numbers")
        return array.astype(float)
    except (TypeError, ValueError, RuntimeError):  # RuntimeError: of a tensor that requires a gradient
        raise ControlError(f"{label} is {values!r}; it must hold numbers") from None
