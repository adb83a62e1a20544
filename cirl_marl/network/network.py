"""The thermodynamical material network: compartments, flow laws, roles and the circularity they imply.

A network is a digraph of compartments that handle one target material. A *node* holds a stock ``x_i``, or stores
nothing and hands on at once what enters it; an *arc* ``k: i → j`` carries a flow ``f_k``. Only the network moves mass::

    dx/dt = S f,    S[i, k] = -1 if i donates to arc k, +1 if i receives from it

with 0 in place of dx/dt for a node that stores nothing, so mass is conserved by construction. Circularity is derived
from the roles of the nodes and is never written by hand (Zocco et al., CiRL, Definition 2).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from cirl_marl.errors import CirlError, NetworkError, check_names, unknown_name
from cirl_marl.network.declarations import declarations
from cirl_marl.network.elements import SINKS, Arc, Compartment, ControlKind, Law, Node, Role, Service
from cirl_marl.network.initial_ages import age_shares, remaining_history
from cirl_marl.network.processes import DisturbanceProcesses
from cirl_marl.network.rowsum import Floats, Integers, RowSum, spans
from cirl_marl.network.series import Series
from cirl_marl.network.specification import Specification
from cirl_marl.network.split_fractions import Split, is_order, splits
from cirl_marl.network.substances import CONTENT, changes, changing_sources, contents
from cirl_marl.network.uncertainty import CAPACITY, CERTAIN, factor_ranges
from cirl_marl.network.validation import problems
from cirl_marl.network.validation.content_limits import limit_problems

if TYPE_CHECKING:
    import networkx

RESERVE = 1e-6
"""Share by which a source without a known reserve starts with more than can be asked of it, so that nothing is cut."""


def names_text(names: Sequence[str], most: int = 8) -> str:
    """Return how many names there are, and the first of them.

    >>> names_text(["mine", "use", "yard"], 2)
    '3 (mine, use, …)'
    """
    text = ", ".join([*names[:most], *(["…"] if len(names) > most else [])])
    return f"{len(names)} ({text})" if names else "0"


@dataclass(frozen=True, kw_only=True)
class Network(Specification):
    """A thermodynamical material network under one scenario; its attributes are those of ``Specification``."""

    def __post_init__(self) -> None:
        """Put nodes with a stock first; refuse a network that cannot be simulated, naming every fault."""
        object.__setattr__(self, "nodes", tuple(sorted(self.nodes, key=lambda node: not node.stores)))
        faults = list(problems(self)) or list(() if self.is_variant else limit_problems(self))
        if faults:
            raise NetworkError(f"network '{self.name}'", faults)

    def __str__(self) -> str:
        """Say in a few lines what it is; ``repr`` has every number.

        >>> from cirl_marl import load_network
        >>> print(load_network("net_zero"))
        net_zero: Digester, atmosphere and microalgae: emission against removal
          scenario: default (others: droop, paper_droop, paper_monod)
          material: carbon dioxide, in kg and day
          nodes: 3, of which 0 without stock; arcs: 2
          agents: 2 (digester, microalgae)
          services: 1 (methane)
          episode: 120 intervals of 0.25 day
        """
        episode, without = self.episode, sum(not node.stores for node in self.nodes)
        scenarios = ", ".join(sorted(self.scenarios))
        counts = {"agents": self.agents, "services": [service.id for service in self.services]}
        counts |= {key: [part.id for part in getattr(self, key)] for key in ("accounts", "substances")}
        counts["disturbances"] = list(self.disturbances)
        lists = {key: names_text(names) for key, names in counts.items() if names or key in ("agents", "services")}
        return "\n  ".join(
            [
                f"{self.name}: {self.title}".removesuffix(": "),
                f"scenario: {self.scenario_name}" + (f" (others: {scenarios})" if scenarios else ""),
                f"material: {self.material}, in {self.mass_unit} and {self.time_unit}",
                f"nodes: {len(self.nodes)}, of which {without} without stock; arcs: {len(self.arcs)}",
                *(f"{key}: {text}" for key, text in lists.items()),
                f"episode: {episode.horizon} intervals of {episode.control_interval:g} {self.time_unit}",
            ]
        )

    def __getstate__(self) -> dict[str, object]:
        """Pickle the fields, not the arrays derived from them."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def scenario(self, name: str | None) -> Network:
        """Return this network under scenario ``name`` (None: as it is); a ``CirlError`` lists those there are."""
        if name is None or name == self.scenario_name:
            return self
        if not isinstance(name, str) or name not in self.scenarios:
            names = sorted({self.scenario_name, *self.scenarios})
            hint = "" if self.scenarios else " A network with other options has no other scenarios: choose it first."
            raise CirlError(f"network '{self.name}': {unknown_name('scenario', name, names)}{hint}")
        network: Network = self.scenarios[name]
        return network

    def with_options(self, **groups: Mapping[str, object]) -> Network:
        """Return a copy with fields of ``episode``, ``objective`` or ``observation`` replaced.

        The copy has no other scenarios: they would not have these options.

        >>> from cirl_marl import load_network
        >>> load_network("copper_net").with_options(episode={"horizon": 3}).episode.horizon
        3
        """
        for group, values in groups.items():
            check_names("group", [group], ["episode", "objective", "observation"], "with_options: ")
            names = [item.name for item in fields(getattr(self, group))]
            check_names("field", values, names, f"with_options: {group}: ")
        changes = {group: replace(getattr(self, group), **dict(values)) for group, values in groups.items()}
        return self.variant(**changes)

    def variant(self, **changes: Any) -> Network:
        """Return a copy with other fields and no other scenarios, in which limits of contents may be out of reach."""
        return replace(self, **changes, scenarios={}, is_variant=True)

    def in_local_order(self) -> Network:
        """Return the same network with neighbours next to each other: nodes by reverse Cuthill-McKee, arcs by donor.

        It changes the order of every array and nothing else, but for round-off; the copy has no other scenarios. A step
        of a large network whose compartments come in random order spends most of its time waiting for memory; in this
        order it does not.
        """
        from scipy.sparse import csgraph

        size = len(self.nodes)
        links = sparse.csr_array((np.ones(len(self.arcs)), (self.donors, self.recipients)), shape=(size, size))
        order = csgraph.reverse_cuthill_mckee(sparse.csr_array(links + links.T), symmetric_mode=True)
        place = np.empty(size, dtype=np.intp)
        place[order] = np.arange(size)
        arcs = np.lexsort((place[self.recipients], place[self.donors]))
        return replace(
            self, nodes=tuple(self.nodes[i] for i in order), arcs=tuple(self.arcs[k] for k in arcs), scenarios={}
        )

    @cached_property
    def compartments(self) -> Mapping[str, Compartment]:
        """Every compartment by id, nodes first."""
        return MappingProxyType({c.id: c for c in (*self.nodes, *self.arcs)})

    def counterpart(self, compartment: str) -> str | None:
        """Return the id that a compartment of a copy has in what was copied; None if it is of no copy.

        Ids of a copy begin with its region. An arc is of a copy if one of its ends is.
        """
        part = self.compartments[compartment]
        places = {part.donor, part.recipient} if isinstance(part, Arc) else {part.id}
        for region, nodes in self._nodes_of_copies.items():
            if part.id.startswith(f"{region}_") and places & nodes:
                return part.id.removeprefix(f"{region}_")
        return None

    def by_service(self, name: str, values: ArrayLike, meaning: str, episodes: tuple[int, ...] = ()) -> Floats:
        """Return numbers of services, shape (*episodes, services), of an option ``name``; one number is for every one.

        Raises:
            CirlError: for a shape that cannot be broadcast to it, with the ``meaning`` of a number.
        """
        shape = (*episodes, len(self.services))
        try:
            return np.broadcast_to(np.asarray(values, dtype=float), shape)
        except ValueError:
            ids = ", ".join(service.id for service in self.services) or "none"
            message = f"{name} has shape {np.shape(values)}, expected {shape}: {meaning} for each service ({ids})"
            raise CirlError(message) from None

    def region_of(self, compartment: str) -> str:
        """Return the region whose copy a compartment is of; of an arc, that of its donor before its recipient's."""
        part = self.compartments[compartment]
        places = [part.donor, part.recipient] if isinstance(part, Arc) else [part.id]
        return next((self._region_of_nodes[place] for place in places if place in self._region_of_nodes), "")

    @cached_property
    def _region_of_nodes(self) -> Mapping[str, str]:
        return {node: region for region, nodes in self.copies.items() for node in nodes}

    @cached_property
    def _nodes_of_copies(self) -> Mapping[str, frozenset[str]]:
        return {region: frozenset(nodes) for region, nodes in self.copies.items()}

    @cached_property
    def stores(self) -> tuple[Node, ...]:
        """Nodes that hold a stock, the first of ``nodes``, in the order of every stock array."""
        return tuple(node for node in self.nodes if node.stores)

    @cached_property
    def initial(self) -> Floats:
        """Lowest and highest stock at the start, shape (2, stores), mass.

        A source without a known reserve starts with the most that its scheduled outflows can ask for in an episode, of
        each substance if its contents change, a node with a history with what is left of it.
        """
        bounds = [node.initial or (0.0, 0.0) for node in self.stores]
        initial = np.array(bounds, dtype=float).reshape(-1, 2).T.copy()
        for i, node in enumerate(self.stores):
            if node.initial is None and node.history is not None:
                initial[:, i] = remaining_history(node, self.episode.control_interval).sum()
        without_start = {node.id for node in self.stores if node.initial is None and node.history is None}
        reserves = {id_: reserve.sum() for id_, reserve in self._reserves.items()}
        for arc in self.arcs:
            if arc.donor in without_start and arc.donor not in reserves:
                demand = self._demand(arc).sum() * self.episode.control_interval
                initial[:, self.node_index[arc.donor]] += demand * (1 + RESERVE)
        for id_ in without_start & reserves.keys():
            initial[:, self.node_index[id_]] = reserves[id_]
        return _read_only(initial)

    @cached_property
    def _factor_ranges(self) -> Mapping[str, tuple[float, float]]:
        return factor_ranges(self, with_draws=True)

    def _demand(self, arc: Arc) -> Floats:
        """Return the most that can be asked of a scheduled arc in each interval, shape (horizon,), mass/time."""
        ranges, donor = self._factor_ranges, self.nodes[self.node_index[arc.donor]]
        base = self.interval_means(arc.flow) * ranges.get(f"arcs.{arc.id}.flow", CERTAIN)[1]
        base = np.ones_like(base) if arc.law is Law.CONTROLLED else base
        # a valve on the donor scales all its outflows, a control that sets a flow is of the controlled one
        sets = [(f"arcs.{arc.id}", arc.control), (f"nodes.{donor.id}", donor.control)]
        factors = [
            self.interval_means(control.high)
            * math.prod(ranges.get(f"{path}.{name}", CERTAIN)[1] for name in ("control", CAPACITY))
            for path, control in sets
            if control is not None and (control.kind is ControlKind.RATE or arc.law is Law.CONTROLLED)
        ]
        return np.asarray(np.prod([base, *factors], axis=0))

    @cached_property
    def _reserves(self) -> Mapping[str, Floats]:
        return {source.id: self._reserve(source) for source in changing_sources(self)}

    def _reserve(self, source: Node) -> Floats:
        """Return the most that can be asked of each component of a changing source, shape (components,), mass."""
        parts = contents(self, source, self.interval_means)
        for row, substance in enumerate(self.substances, start=1):
            low, high = self._factor_ranges.get(f"nodes.{source.id}.{CONTENT}{substance.id}", CERTAIN)
            parts[0] += (1.0 - low) * parts[row]
            parts[row] *= high
        demand = sum((self._demand(arc) for arc in self.arcs if arc.donor == source.id), np.zeros(parts.shape[1]))
        return np.asarray(parts @ demand * self.episode.control_interval * (1 + RESERVE))

    def start_shares(self, node: Node) -> Floats:
        """Return the part of a node's initial stock that is in each of its rows: by component, and in each by age.

        Of a changing source the components are as what can be asked of each at most.
        """
        interval = self.episode.control_interval
        ages = np.ones(1) if node.lifetime is None else age_shares(node, interval)
        if not self.substances:
            return ages
        if node.history is not None and changes(node):
            content = dict(node.content)
            masses = [remaining_history(node, interval, content.get(part.id, 0.0)) for part in self.substances]
            whole = remaining_history(node, interval)
            return np.asarray(np.concatenate([np.maximum(whole - sum(masses), 0.0), *masses]) / whole.sum())
        if node.id in self._reserves:
            reserve = self._reserves[node.id]
            parts = reserve if reserve.any() else contents(self, node, self.interval_means)[:, 0]
            return np.asarray(parts / parts.sum())
        return np.asarray(np.kron(contents(self, node, lambda content: np.array([content]))[:, 0], ages))

    @cached_property
    def node_index(self) -> Mapping[str, int]:
        """Position of each node; those that hold a stock come first, so it is their position in stock arrays too."""
        return MappingProxyType({node.id: i for i, node in enumerate(self.nodes)})

    @cached_property
    def arc_index(self) -> Mapping[str, int]:
        """Position of each arc in flow arrays."""
        return MappingProxyType({arc.id: k for k, arc in enumerate(self.arcs)})

    @cached_property
    def donors(self) -> Integers:
        """Donor node of each arc, shape (arcs,)."""
        return _read_only(np.array([self.node_index[arc.donor] for arc in self.arcs], dtype=np.intp))

    @cached_property
    def recipients(self) -> Integers:
        """Recipient node of each arc, shape (arcs,)."""
        return _read_only(np.array([self.node_index[arc.recipient] for arc in self.arcs], dtype=np.intp))

    @cached_property
    def orders(self) -> tuple[int, ...]:
        """Arcs that order from nodes that store nothing, by position."""
        stockless = {node.id for node in self.nodes if not node.stores}
        return tuple(k for k, arc in enumerate(self.arcs) if is_order(arc, stockless))

    @cached_property
    def splits(self) -> tuple[Split, ...]:
        """How arcs of law ``share`` divide what leaves nodes, in the order of the nodes."""
        return tuple(splits(self))

    @cached_property
    def controllable(self) -> tuple[str, ...]:
        """Compartments that have a control, nodes first, in definition order."""
        return tuple(c.id for c in self.compartments.values() if c.control is not None)

    @cached_property
    def processes(self) -> DisturbanceProcesses:
        """The disturbances that disturb something, at work."""
        return DisturbanceProcesses(self)

    @cached_property
    def control_rows(self) -> Mapping[str, slice]:
        """Rows of each controllable compartment in control arrays: one, or one per input of its model."""
        rows = spans(self.compartments[id_].actions for id_ in self.controllable)
        return MappingProxyType(dict(zip(self.controllable, rows, strict=True)))

    @cached_property
    def control_bounds(self) -> Floats:
        """Low, neutral and high value of each control in each interval, shape (3, controls, horizon)."""
        controls = [c.control for id_ in self.controllable for c in [self.compartments[id_]] for _ in range(c.actions)]
        triples = [(actuator.low, actuator.neutral, actuator.high) for actuator in controls if actuator is not None]
        shape = (3, len(triples), self.episode.horizon)
        if not any(isinstance(value, Series) for triple in triples for value in triple):
            constant = np.array(triples, dtype=float).reshape(-1, 3).T
            return np.broadcast_to(constant[:, :, None], shape)
        bounds = [[self.interval_means(value) for value in side] for side in zip(*triples, strict=True)]
        return _read_only(np.array(bounds))

    @cached_property
    def agents(self) -> tuple[str, ...]:
        """Compartments that act by default."""
        return self.default_agents or self.controllable

    @cached_property
    def time_dependent(self) -> tuple[str, ...]:
        """Compartments of which a number, or a bound of the control, changes in time."""
        parts = [(c.id, part) for c in self.compartments.values() for part in (c, c.control) if part is not None]
        ids = (
            id_
            for id_, part in parts
            if any(isinstance(getattr(part, name), Series) for name in declarations(type(part)))
            or (isinstance(part, Node) and changes(part))
        )
        return tuple(dict.fromkeys(ids))

    @cached_property
    def sustainability(self) -> Floats:
        """σ_k of each arc: the sign with which its flow counts as finite-time sustainable, shape (arcs,).

        +1 if material leaves a non-renewable reservoir or enters a landfill, an incinerator or, as a pollutant, the
        environment; −1 if it leaves the environment or returns to a reservoir; 0 otherwise or if both hold. What goes
        from one compartment of the environment to another neither enters nor leaves it.
        """
        environment, reservoirs = self._of_role(Role.ENVIRONMENT), self._of_role(Role.NONRENEWABLE_RESERVOIR)
        sinks, (donors, recipients) = self._of_role(*SINKS), (self.donors, self.recipients)
        within = environment[donors] & environment[recipients]
        pollutes = np.array([arc.pollutant for arc in self.arcs], dtype=bool)
        enters = sinks[recipients] & ~within & (pollutes | ~environment[recipients])
        loses = reservoirs[donors] | enters
        regains = (environment[donors] & ~within) | reservoirs[recipients]
        return _read_only(loses.astype(float) - regains)

    @cached_property
    def environmental(self) -> NDArray[np.bool_]:
        """Arcs that touch the environment, whose net flow is φ_nz, shape (arcs,)."""
        environment = self._of_role(Role.ENVIRONMENT)
        return _read_only(environment[self.donors] | environment[self.recipients])

    @cached_property
    def graph(self) -> networkx.DiGraph:
        """The network as a frozen networkx digraph; parallel arcs share an edge, whose ``arcs`` are all of them."""
        import networkx

        graph = networkx.DiGraph(name=self.name)
        for node in self.nodes:
            graph.add_node(node.id, role=node.role.value, compartment=node)
        for arc in self.arcs:
            parallel = graph.get_edge_data(arc.donor, arc.recipient, {"arcs": ()})["arcs"]
            graph.add_edge(arc.donor, arc.recipient, arcs=(*parallel, arc))
        networkx.freeze(graph)
        return graph

    def circularity(self, flow: Floats, batch_mass: Floats | None = None) -> Floats:
        """Return λ(N;t) = −(m_fb + Δ·σᵀf), shape (...), mass, with σᵀf summed over the continuous flows.

        With ``net_zero = "abs"`` the part through the environment enters by its absolute value,
        λ = −(m_rest + Δ·σ_rest·f) − |m_env + Δ·σ_env·f|. Given mean flows this is λ of the mean flows, which for
        ``abs`` is not the mean of λ if the net flow changes its sign within the interval.

        Args:
            flow: f, shape (arcs, ...), mass/time; entries of batch arcs are ignored.
            batch_mass: m_fb, net batch mass moved finite-time sustainably so far, not through and through the
                environment, shape (2, ...), mass; None if nothing moves in batches.

        Raises:
            CirlError: if there is not one flow for each arc.

        References: Zocco et al., CiRL (arXiv 2505.21536), Definition 2.
        """
        if flow.shape[:1] != (len(self.arcs),):
            expectation = f"the first axis is that of its {len(self.arcs)} arcs, {', '.join(self.arc_index)}"
            raise CirlError(f"network '{self.name}': flows of shape {flow.shape}; {expectation}")
        columns = (2, math.prod(flow.shape[1:]))
        parts = self._circularity_parts(flow.reshape(len(self.arcs), columns[1]))
        if batch_mass is not None:
            parts = parts - batch_mass.reshape(columns)
        through = -np.abs(parts[1]) if self.objective.net_zero == "abs" else parts[1]
        circularity: Floats = (parts[0] + through).reshape(flow.shape[1:])
        return circularity

    def circularity_adjoint(self, flow: Floats) -> Floats:
        """Return dλ/df, shape (arcs, B), mass per mass/time; where a net flow to the environment is 0, as if it were 1.

        Args:
            flow: f, shape (arcs, B), mass/time.
        """
        signs = np.ones((2, flow.shape[1]))
        if self.objective.net_zero == "abs":
            signs[1] = np.where(self._circularity_parts(flow)[1] > 0, -1.0, 1.0)
        return self._circularity_parts.transpose()(signs)

    @cached_property
    def circularity_weights(self) -> Floats:
        """−Δ·σ_rest and −Δ·σ_env, weights in λ of flows not through and through the environment, shape (2, arcs)."""
        continuous = np.array([arc.law is not Law.BATCH for arc in self.arcs], dtype=bool)
        weights = -self.objective.reference_interval * self.sustainability * continuous
        return _read_only(np.stack([weights * ~self.environmental, weights * self.environmental]))

    @cached_property
    def _circularity_parts(self) -> RowSum:
        rows, arcs = np.nonzero(self.circularity_weights)
        return RowSum(rows, arcs, self.circularity_weights[rows, arcs], (2, len(self.arcs)))

    def throughput(self, flow: Floats) -> Floats:
        """Return what passes through each node that stores nothing, the sum of its outflows, shape (nodes, ...).

        Args:
            flow: f, shape (arcs, ...), mass/time.
        """
        columns = math.prod(flow.shape[1:])
        through = self._throughputs(np.ascontiguousarray(flow).reshape(len(self.arcs), columns))
        return through.reshape(-1, *flow.shape[1:])

    def throughput_adjoint(self, worth: Floats) -> Floats:
        """Return derivatives by the flows, shape (arcs, B), of those by the throughputs, shape (nodes, B)."""
        return self._throughputs.transpose()(worth)

    @cached_property
    def _throughputs(self) -> RowSum:
        exits = np.flatnonzero(self.donors >= len(self.stores))
        shape = (len(self.nodes) - len(self.stores), len(self.arcs))
        return RowSum(self.donors[exits] - len(self.stores), exits, 1.0, shape)

    def service_arcs(self, service: Service) -> Integers:
        """Return the arcs whose flows add up to what a service of quantity ``flow`` or ``outflow`` measures."""
        if service.quantity == "outflow":
            nodes = [self.node_index[id_] for id_ in service.providers]
            return np.flatnonzero(np.isin(self.donors, nodes))
        return np.array([self.arc_index[id_] for id_ in service.providers])

    def _of_role(self, *roles: Role) -> NDArray[np.bool_]:
        """Return which nodes have one of these roles, shape (nodes,)."""
        return np.array([self._role(node.id) in roles for node in self.nodes], dtype=bool)

    def _role(self, node: str) -> Role:
        return self.nodes[self.node_index[node]].role


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Keep what a network derives once from being written to: networks are shared."""
    array.flags.writeable = False
    return array
