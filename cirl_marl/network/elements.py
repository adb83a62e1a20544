"""The parts of a network definition: nodes, arcs, controls, services and settings, as frozen data."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from cirl_marl.network.fields import check_numbers, choice
from cirl_marl.network.rowsum import Floats

if TYPE_CHECKING:
    from cirl_marl.network.model import CompartmentModel


class Role(StrEnum):
    """What a node is to the circular economy."""

    NONRENEWABLE_RESERVOIR = "nonrenewable_reservoir"
    TECHNOSPHERE = "technosphere"
    LANDFILL = "landfill"
    INCINERATOR = "incinerator"
    ENVIRONMENT = "environment"


class Law(StrEnum):
    """How much an arc carries."""

    DONOR = "donor"
    RECIPIENT = "recipient"
    CONTROLLED = "controlled"
    EXOGENOUS = "exogenous"
    COMPARTMENT = "compartment"
    BATCH = "batch"


class ControlKind(StrEnum):
    """What an agent sets.

    A factor on flows (``rate``, a valve), the flow itself (``flow``) or an input of the model (``input``).
    """

    RATE = "rate"
    FLOW = "flow"
    INPUT = "input"


@dataclass(frozen=True, slots=True, kw_only=True)
class Control:
    """The actuator of one compartment; a normalised action in [-1, 1] maps linearly onto [low, high].

    Attributes:
        kind: ``rate`` (dimensionless factor), ``flow`` (mass/time) or ``input`` (unit of the model's inputs; the bounds
            hold for each of them, and the action has one entry per input).
        low: value at action -1.
        high: value at action +1.
        neutral: value while nobody acts on the compartment.
    """

    kind: ControlKind
    low: float
    high: float
    neutral: float

    def __post_init__(self) -> None:
        """Refuse what is no number; take a kind as definitions spell it."""
        check_numbers("control", self)
        object.__setattr__(self, "kind", choice("control", "kind", ControlKind, self.kind))

    def action(self, value: Floats) -> Floats:
        """Return the normalised actions, in [-1, 1], that come closest to physical values."""
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        action: Floats = np.clip((value - middle) / half, -1.0, 1.0)
        return action


@dataclass(frozen=True, slots=True, kw_only=True)
class Compartment:
    """What nodes and arcs have in common.

    Attributes:
        id: unique among nodes and arcs.
        set_point: stock (mass) or mean flow (mass/time) aimed at; None if it has none.
        scale: reference stock or flow for observations and rewards.
        control: its actuator; None if it cannot act.
        model: inner physics; None for a plain store or transport.
        inner: (low, high) of the initial value of each inner state of the model, drawn uniformly; empty for a model
            that draws its own start.
        reward_scale: the model's reward is divided by it.
    """

    id: str
    set_point: float | None = None
    scale: float = 1.0
    control: Control | None = None
    model: CompartmentModel | None = None
    inner: tuple[tuple[float, float], ...] = ()
    reward_scale: float = 1.0

    @property
    def actions(self) -> int:
        """Number of entries of its action."""
        if self.control is None:
            return 0
        takes_inputs = self.control.kind is ControlKind.INPUT and self.model is not None
        return len(self.model.input_names) if takes_inputs and self.model is not None else 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Node(Compartment):
    """A compartment that stores material.

    A ``rate`` control scales every outflow, a ``flow`` control sets the one controlled outflow.

    Attributes:
        role: decides which flows count as finite-time sustainable.
        initial: (low, high) of the initial stock, drawn uniformly, mass.
    """

    role: Role = Role.TECHNOSPHERE
    initial: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Refuse what is no number; take a role as definitions spell it."""
        check_numbers(f"node '{self.id}'", self)
        object.__setattr__(self, "role", choice(f"node '{self.id}'", "role", Role, self.role))


@dataclass(frozen=True, slots=True, kw_only=True)
class Arc(Compartment):
    """A compartment that moves material from ``donor`` to ``recipient``.

    Attributes:
        donor: id of the node that gives.
        recipient: id of the node that receives.
        law: ``donor`` f = a·x_donor, ``recipient`` f = a·x_recipient, ``controlled`` f = u, ``exogenous`` f = e(t),
            ``compartment`` f = a·y, y the output of the model of the compartment ``by``, ``batch`` discrete masses.
        rate: a, 1/time (donor and recipient laws), mass/time per unit of the model's output, or mass per unit that the
            donor's model releases (batch law).
        by: the compartment whose model gives the flow (compartment law) or releases the batches (batch law).
        port: what ``by`` releases into this arc, one of the ports of its model (batch law).
        batches: (time, mass) of batches that leave on schedule (batch law without ``by``).
        delay: transit time of a batch, a whole number of control intervals; 0 if the arc's own model is the vehicle.
        flow: e, mass/time (exogenous law); with ``times`` the values of a step function, else a single value.
        times: starts of the steps of an exogenous series, time; empty for a constant.
        pollutant: whether material that enters an environment here is a pollutant.
    """

    donor: str
    recipient: str
    law: Law = Law.DONOR
    rate: float = 0.0
    by: str = ""
    port: str = ""
    batches: tuple[tuple[float, float], ...] = ()
    delay: float = 0.0
    flow: tuple[float, ...] = (0.0,)
    times: tuple[float, ...] = ()
    pollutant: bool = True

    def __post_init__(self) -> None:
        """Refuse what is no number; take a law as definitions spell it."""
        check_numbers(f"arc '{self.id}'", self)
        object.__setattr__(self, "law", choice(f"arc '{self.id}'", "law", Law, self.law))


@dataclass(frozen=True, slots=True, kw_only=True)
class Service:
    """What the network is there for: a stock or flow to be kept within a band.

    The level is 1 inside ``[low, high]``, ``q/low`` below it and ``high/q`` above it; the shortfall is 1 - level. A
    band from 0 only bounds what piles up.

    Attributes:
        id: name of the service.
        provider: compartment at which it is measured.
        quantity: ``stock`` (of a node, or on the way along a batch arc), ``outflow`` of a node (sum of its outflows,
            none of them in batches), ``flow`` of an arc, or ``measure``, one that the provider's model offers.
        measure: its name, for ``quantity = "measure"``.
        low: lower end of the band, mass, mass/time or the unit of the measure.
        high: upper end of the band.
        weight: factor of the shortfall in the local rewards.
        owed_by: compartments whose local reward bears the shortfall; empty means the provider alone.
    """

    id: str
    provider: str
    quantity: str
    low: float
    high: float = math.inf
    weight: float = 1.0
    measure: str = ""
    owed_by: tuple[str, ...] = ()

    @property
    def debtors(self) -> tuple[str, ...]:
        """Compartments whose local reward bears the shortfall."""
        return self.owed_by or (self.provider,)


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    """Time and solver of an episode.

    Attributes:
        control_interval: h, time between two decisions.
        horizon: decisions per episode.
        solver: ``exact`` (zero-order-hold solution, for networks without inner physics), ``rk4`` (classical
            Runge-Kutta, for those with it), both keeping stocks non-negative; or ``euler`` (the explicit step of the
            published environments; stocks may become negative).
        solver_step: step of the ``rk4`` and ``euler`` solvers, time; a whole fraction of ``control_interval``.
    """

    control_interval: float = 1.0
    horizon: int = 50
    solver: str = "exact"
    solver_step: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Objective:
    """How circularity and rewards are read off the network.

    Attributes:
        reference_interval: Δ of λ = −(m_fb + Δ·ṁ_fc), time.
        net_zero: ``signed`` counts over-removal from the environment as positive; ``abs`` penalises it like emission.
        reward: default reward mode of the environments.
        circularity_scale: reference |λ|, mass.
        circularity_weight: weight w of λ in ``mixed`` = w·λ/scale + (1 − w)·local.
        tracked: compartments whose distance to the set-point enters their local reward; empty means every
            compartment with a set-point.
        criticality: c of the material; evaluations then report the time-window circularity of CIRO7.2 too.
    """

    reference_interval: float = 1.0
    net_zero: str = "signed"
    reward: str = "mixed"
    circularity_scale: float = 1.0
    circularity_weight: float = 0.5
    tracked: tuple[str, ...] = ()
    criticality: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """What agents see by default.

    Attributes:
        mode: ``local``, ``neighbours``, ``full``, ``stocks`` (the stocks of ``nodes`` in that order) or ``model`` (what
            the agent's own model shows, nothing else).
        nodes: in mode ``stocks``, the observed stocks (ids of nodes) and inner states (``compartment.state``).
    """

    mode: str = "local"
    nodes: tuple[str, ...] = ()


Solver = Literal["exact", "rk4", "euler"]
NetZero = Literal["signed", "abs"]
Reward = Literal["local", "circularity", "mixed", "difference", "mixed_difference", "local_sum", "team"]
Observe = Literal["local", "neighbours", "full", "stocks", "model"]
Moment = Literal["end", "mean"]
ServiceQuantity = Literal["stock", "outflow", "flow", "measure"]

SOLVERS: tuple[str, ...] = get_args(Solver)
NET_ZERO: tuple[str, ...] = get_args(NetZero)
REWARDS: tuple[str, ...] = get_args(Reward)
OBSERVE: tuple[str, ...] = get_args(Observe)
MOMENTS: tuple[str, ...] = get_args(Moment)
QUANTITIES: tuple[str, ...] = get_args(ServiceQuantity)
SINKS = frozenset({Role.LANDFILL, Role.INCINERATOR, Role.ENVIRONMENT})
MAX_STEPS = 10_000
"""Solver steps of a control interval, or control intervals of a delay, beyond which a unit is taken for a mistake."""
