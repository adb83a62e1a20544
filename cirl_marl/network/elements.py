"""The parts of a network definition: nodes, arcs, controls, services and settings, as frozen data.

Each field is declared here and nowhere else (``declared``): reading, writing, schema, checks and documents derive
from it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import date
from enum import StrEnum
from typing import Annotated, Literal, get_args

from cirl_marl.network.compartment_model import CompartmentModel
from cirl_marl.network.declarations import (
    Amount,
    CalendarTime,
    CheckedRecord,
    Declaration,
    Kinds,
    NotNegative,
    Numbers,
    Positive,
    Quantity,
    Rates,
    Share,
    Subtable,
    Word,
    frozen_record,
)
from cirl_marl.network.lifetimes import SURVIVALS, Chain, chain_of
from cirl_marl.network.piecewise import PiecewiseRate
from cirl_marl.network.series import Series, Value, extremes


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
    SHARE = "share"


class ControlKind(StrEnum):
    """What an agent sets.

    A factor on flows (``rate``, a valve), the flow itself (``flow``), a share of what leaves the donor (``share``), a
    factor on the lifetime of all that is in use (``stretch``), the share of some substances in what leaves the donor
    (``transfer``) or an input of the model (``input``).
    """

    RATE = "rate"
    FLOW = "flow"
    SHARE = "share"
    STRETCH = "stretch"
    TRANSFER = "transfer"
    INPUT = "input"


Reward = Literal["local", "circularity", "mixed", "difference", "mixed_difference", "local_sum", "team"]
Observe = Literal["local", "neighbours", "full", "stocks", "model"]
Moment = Literal["end", "mean"]

REWARDS: tuple[str, ...] = get_args(Reward)
OBSERVE: tuple[str, ...] = get_args(Observe)
MOMENTS: tuple[str, ...] = get_args(Moment)
SINKS = frozenset({Role.LANDFILL, Role.INCINERATOR, Role.ENVIRONMENT})
IDENTIFIER = r"^[a-z][a-z0-9_]*$"
"""How compartments and services may be called; their names are keys of definition files and names of files."""
MAX_STEPS = 10_000
"""Solver steps of a control interval, or control intervals of a delay, beyond which a unit is taken for a mistake."""

LAW_FIELDS: Mapping[Law, tuple[str, ...]] = {
    Law.DONOR: ("rate",),
    Law.RECIPIENT: ("rate",),
    Law.CONTROLLED: (),
    Law.EXOGENOUS: ("flow",),
    Law.COMPARTMENT: ("rate", "by"),
    Law.BATCH: ("rate", "by", "port", "batches", "delay"),
    Law.SHARE: ("share",),
}
"""What each law takes, of the fields that only some laws take."""

RATE_OF = Kinds("law", {Law.COMPARTMENT: "flow", Law.BATCH: "mass"}, "rate")
SCALE_OF = Kinds("law", {Law.BATCH: "mass"}, "flow")
LEVEL_OF = Kinds("stores", {False: "flow"}, "mass")
BAND_OF = Kinds("quantity", {"stock": "mass", "measure": "1"}, "flow", content_of="substance")

Pair = tuple[float, float]
NamedValues = Mapping[str, Value] | tuple[tuple[str, Value], ...]
"""Numbers by substance; parts keep them as pairs, which can be hashed."""
Rate = Value | PiecewiseRate
NamedRates = Mapping[str, Rate] | tuple[tuple[str, Rate], ...]
"""Rates by account, likewise."""


@frozen_record
class Control(CheckedRecord):
    """The actuator of one compartment; a normalised action in [-1, 1] maps linearly onto [low, high]."""

    kind: Annotated[
        ControlKind,
        Word(
            "``rate``, a factor on flows; ``flow``, mass/time; ``share``, of what leaves the donor; ``stretch``, a "
            "factor on the node's lifetime; ``transfer``, the share of ``substances``; or ``input``, of a model",
            of=ControlKind,
        ),
    ]
    low: Annotated[Value, Amount("value at action −1, of each entry of the action")]
    neutral: Annotated[Value, Amount("value while nobody acts on the compartment")]
    high: Annotated[Value, Amount("value at action +1, of each entry of the action")]
    substances: Annotated[
        tuple[str, ...], Declaration("of which kind ``transfer`` sets the share; all else has the ``share`` of the arc")
    ] = ()

    @property
    def nominal(self) -> Value:
        """What its deviation is of: the neutral value or, where that is 0 at all times, the highest."""
        return self.high if extremes(self.neutral) == (0.0, 0.0) else self.neutral


FIXED_LIFETIME = "fixed"
"""The distribution of a lifetime that is the same for all."""


@frozen_record
class Lifetime(CheckedRecord):
    """How long what enters a node stays there."""

    mean: Annotated[
        float, Positive("mean; of a folded normal distribution that before it is folded", of="time", unit_of_table=True)
    ]
    deviation: Annotated[
        float | None,
        Positive(
            "standard deviation, likewise; a fixed lifetime has none, nor need an exponential one",
            of="time",
            unit_of_table=True,
        ),
    ] = None
    distribution: Annotated[
        str,
        Word(
            "``normal`` (what is below 0 leaves at once), ``folded_normal``, ``lognormal``, ``weibull``, ``gamma``, "
            "``exponential``, or ``fixed``, a whole number of control intervals",
            of=(*SURVIVALS, FIXED_LIFETIME),
            mandatory=True,
        ),
    ] = "normal"

    @property
    def chain(self) -> Chain | None:
        """The stages of which it is made, for a mean of 1; None if it is fixed."""
        if self.distribution == FIXED_LIFETIME:
            return None
        return chain_of(self.distribution, (self.deviation or self.mean) / self.mean)


@frozen_record
class FeedbackRule(CheckedRecord):
    """What an agent does under scripted control, u = u₀·Π ξ_j·(1 + Σ g_i·(1 − q_i/aim_i)), within its bounds.

    It knows the disturbances ξ_j of the coming interval and the quantities q_i at its start.
    """

    level: Annotated[
        float | None,
        Quantity("normalised action, −1 to 1, whose value is u₀; None: the neutral one", low=-1.0, high=1.0),
    ] = None
    follows: Annotated[tuple[str, ...], Declaration("disturbances that multiply it")] = ()
    watches: Annotated[
        tuple[str, ...],
        Declaration("nodes, whose stocks are aimed at their set-points, and services, aimed at their lower ends"),
    ] = ()
    gains: Annotated[
        tuple[float, ...],
        Numbers(
            "g, how much more, relative to u₀, for what each of these lacks, relative to what is aimed at",
            "(number, …)",
            table_form="list",
        ),
    ] = ()


CONTENT = Quantity("a part of the mass", low=0.0, high=1.0, varies=True)
RATES = Rates(
    "amounts by account, per mass that flows along an arc or enters a node; negative ones are revenues or credits"
)
EFFORT = Rates(
    "amounts by account, per unit of what its control is away from its neutral value, and time",
    per="control",
    number=NotNegative("an amount on an account", of="own", varies=True),
)
LIFETIME = Subtable("how long what enters stays, for arcs of law ``share`` to split what leaves", of="lifetime")
CONTROL = Subtable("its actuator; None if it cannot act")
RULE = Subtable(
    "what it does under scripted control; None: stays neutral, or acts by the script of its model", of="rule"
)
MODEL = Subtable("inner physics; None for a plain store or transport", of="model")
TITLE = Declaration("what it is called in tables and pictures; its id if left out")
INNER = Numbers(
    "(low, high) of the initial value of each inner state of the model, drawn uniformly; empty for a model that draws "
    "its own start",
    "((low, high), …), one pair for each inner state",
    (None, 2),
)


@frozen_record
class Compartment(CheckedRecord):
    """What nodes and arcs have in common."""

    id: str
    title: Annotated[str, TITLE] = ""
    set_point: float | None = None
    scale: float = 1.0
    control: Annotated[Control | None, CONTROL] = None
    rule: Annotated[FeedbackRule | None, RULE] = None
    model: Annotated[CompartmentModel | None, MODEL] = None
    accounts: Annotated[NamedRates, RATES] = ()
    effort: Annotated[NamedRates, EFFORT] = ()
    inner: Annotated[tuple[Pair, ...], INNER] = ()
    reward_scale: Annotated[float, Positive("the model's reward is divided by it")] = 1.0

    @property
    def label(self) -> str:
        """What it is called in pictures: its title, or its id in words."""
        return self.title or self.id.replace("_", " ")

    @property
    def actions(self) -> int:
        """Number of entries of its action."""
        if self.control is not None and self.control.kind is ControlKind.INPUT and self.model is not None:
            return len(self.model.input_names)
        return int(self.control is not None)


@frozen_record
class Node(Compartment):
    """A compartment that stores material, or hands it on at once, with an ``id`` of its own among nodes and arcs.

    A ``rate`` control scales every outflow, a ``flow`` control sets the one controlled outflow. Arcs of law ``share``
    split what ``rate`` releases, what leaves at the end of its ``lifetime``, or all that passes through a node that
    stores nothing.
    """

    role: Annotated[Role, Word("decides which flows count as finite-time sustainable", of=Role, mandatory=True)] = (
        Role.TECHNOSPHERE
    )
    stores: Annotated[
        bool, Declaration("whether it holds a stock; what enters one that does not leaves it at once, in shares")
    ] = True
    initial: Annotated[
        Pair | None,
        Numbers(
            "(low, high) of the initial stock, drawn uniformly, mass; if left out, a node with a history starts with "
            "what is left of that, and one whose outflows are all scheduled with the most that they can ask for in an "
            "episode",
            "(low, high)",
            (2,),
            "range",
        ),
    ] = None
    rate: Annotated[
        Value,
        NotNegative(
            "a, of a stock x the arcs of law ``share`` split a·x, 1/time; 0 without them", of="rate", varies=True
        ),
    ] = 0.0
    lifetime: Annotated[Lifetime | None, LIFETIME] = None
    stretch: Annotated[
        Value,
        Positive(
            "factor on the lifetime of all that is in use; a control of kind ``stretch`` is a further one", varies=True
        ),
    ] = 1.0
    history_stretch: Annotated[
        float, Positive("factor on the lifetime before the episode, from which the ages of the initial stock follow")
    ] = 1.0
    history: Annotated[
        Series | None,
        NotNegative(
            "what entered before the episode, from which the ages of the initial stock follow",
            of="flow",
            varies=True,
            past=True,
        ),
    ] = None
    growth: Annotated[
        float | None,
        Quantity(
            "g, 1/time: before the history, or ever before the episode, what entered grew by e^(g·t); None: nothing "
            "entered before the history, and always the same without one",
            of="rate",
        ),
    ] = None
    holding: Annotated[NamedRates, Rates("amounts by account, per mass that is held and time", per="stock")] = ()
    content: Annotated[
        NamedValues,
        Rates(
            "part of each substance in the initial stock and in the history, in which it may change in time; likewise "
            "in what a source gives that nothing enters and that schedules alone empty",
            of="substance",
            number=CONTENT,
        ),
    ] = ()
    set_point: Annotated[
        float | None, Quantity("stock aimed at, mass, or throughput, mass/time; None if there is none", of=LEVEL_OF)
    ] = None
    scale: Annotated[
        float,
        Positive(
            "reference stock, or throughput, of observations and rewards; files may leave it to scales.stock and "
            "scales.flow",
            of=LEVEL_OF,
        ),
    ] = 1.0


@frozen_record
class Arc(Compartment):
    """A compartment that moves material from ``donor`` to ``recipient``, with an ``id`` of its own.

    The law says how much it carries: ``donor`` f = a·x_donor, ``recipient`` f = a·x_recipient, ``controlled`` f = u,
    ``exogenous`` f = e(t), ``compartment`` f = a·y, y the output of the model of the compartment ``by``, ``batch``
    discrete masses, ``share`` f = s·q, q what the ``rate`` of the donor releases or, if it stores nothing, what enters
    it.
    """

    donor: Annotated[str, Declaration("id of the node that gives", key="from")]
    recipient: Annotated[str, Declaration("id of the node that receives", key="to")]
    law: Annotated[Law, Word("how much it carries", of=Law, mandatory=True)] = Law.DONOR
    rate: Annotated[
        Value,
        NotNegative(
            "a, 1/time (donor and recipient laws), mass/time per unit of the model's output, or mass per unit that the "
            "donor's model releases (batch law)",
            of=RATE_OF,
            varies=True,
        ),
    ] = 0.0
    share: Annotated[
        Value | None,
        Share(
            "s (share law); None, in files ``rest``: what the others leave, or what the control sets. Uncontrolled "
            "shares keep their proportions in what controlled ones leave",
            varies=True,
            none_word="rest",
        ),
    ] = None
    transfer: Annotated[
        NamedValues,
        Rates(
            "shares of substances that differ from s, where the donor separates them; the arc that takes the rest, "
            "takes that of each substance",
            of="substance",
            number=Share("a share", varies=True),
        ),
    ] = ()
    by: Annotated[
        str, Declaration("compartment whose model gives the flow (compartment law) or releases the batches (batch law)")
    ] = ""
    port: Annotated[
        str, Declaration("what ``by`` releases into this arc, one of the ports of its model (batch law)")
    ] = ""
    batches: Annotated[
        tuple[Pair, ...],
        Numbers(
            "(time, mass) of batches that leave on schedule (batch law without ``by``)",
            "((time, mass), …)",
            (None, 2),
            table_form="batches",
        ),
    ] = ()
    delay: Annotated[
        float,
        Quantity(
            "transit time of a batch, a whole number of control intervals; 0 if the arc's own model is the vehicle",
            of="time",
            joint=True,
        ),
    ] = 0.0
    flow: Annotated[Value, NotNegative("e, mass/time (exogenous law)", of="flow", varies=True)] = 0.0
    makes_up_for: Annotated[
        str,
        Declaration(
            "service of which, while nobody acts on it, a controlled flow supplies what would lack in the interval, "
            "within the bounds of its control"
        ),
    ] = ""
    capacity_node: Annotated[
        str,
        Declaration(
            "node, such as a plant or a fleet, of whose stock x at the start of an interval a controlled flow is at "
            "most ``capacity_rate`` · x"
        ),
    ] = ""
    capacity_rate: Annotated[
        Value, NotNegative("flow that a unit of that stock can carry, 1/time", of="rate", varies=True)
    ] = 0.0
    weight: Annotated[
        float | None,
        Share("part of that supply, of arcs that make up for the same service; they sum to 1; None: all of it"),
    ] = None
    pollutant: Annotated[bool, Declaration("whether material that enters an environment here is a pollutant")] = True
    set_point: Annotated[float | None, Quantity("mean flow aimed at, mass/time; None if there is none", of="flow")] = (
        None
    )
    scale: Annotated[
        float,
        Positive(
            "reference flow of observations and rewards, of a batch arc reference mass; files may leave it to "
            "scales.flow and scales.stock",
            of=SCALE_OF,
        ),
    ] = 1.0


@frozen_record
class Service(CheckedRecord):
    """What the network is there for: a stock or flow to be kept within a band, under an ``id`` of its own.

    The level is 1 inside ``[low, high]``, ``q/low`` below it and ``high/q`` above it; the shortfall is 1 - level. A
    band from 0 only bounds what piles up. With a ``substance`` q is its content in the stocks or flows, and the level
    is 1 where there is nothing.
    """

    id: str
    title: Annotated[str, TITLE] = ""
    provider: Annotated[str, Declaration("compartment at which it is measured")]
    quantity: Annotated[
        str,
        Word(
            "``stock`` (of a node, or on the way along a batch arc), ``outflow`` of a node (sum of its outflows, none "
            "of them in batches), ``flow`` of an arc, or ``measure``, one that the provider's model offers",
            of=("stock", "outflow", "flow", "measure"),
        ),
    ]
    also: Annotated[
        tuple[str, ...],
        Declaration("further compartments of which the same quantity is measured and added; no measures"),
    ] = ()
    low: Annotated[
        Value,
        Quantity(
            "lower end of the band: mass, mass/time or the measure's; 0 if left out",
            of=BAND_OF,
            joint=True,
            varies=True,
        ),
    ] = 0.0
    high: Annotated[Value, Quantity("upper end, likewise; none if left out", of=BAND_OF, joint=True, varies=True)] = (
        math.inf
    )
    weight: Annotated[float, NotNegative("factor of the shortfall in the local rewards", mandatory=True)] = 1.0
    measure: Annotated[str, Declaration('name of the measure, for ``quantity = "measure"``')] = ""
    substance: Annotated[
        str,
        Declaration("whose content in the stocks or flows, a part of their mass, is to lie in the band; then 0 to 1"),
    ] = ""
    owed_by: Annotated[
        tuple[str, ...],
        Declaration("compartments whose local reward bears the shortfall; empty means the provider alone"),
    ] = ()

    @property
    def providers(self) -> tuple[str, ...]:
        """Compartments whose quantities add up to what it measures."""
        return (self.provider, *self.also)

    @property
    def subject(self) -> str:
        """What it measures, in a word or two."""
        quantity = self.measure or self.quantity
        return f"{self.substance} in the {quantity}" if self.substance else quantity

    @property
    def debtors(self) -> tuple[str, ...]:
        """Compartments whose local reward bears the shortfall."""
        return self.owed_by or (self.provider,)


CIRCULARITY = "circularity"
"""What plans aim at that is no account."""


def is_of_circularity(aim: object) -> bool:
    """Whether an aim, a name or weights by name, is λ̄."""
    return aim in (CIRCULARITY, {CIRCULARITY: 1.0})


@frozen_record
class Account(CheckedRecord):
    """What is counted beside mass, such as money, emissions or energy, under an ``id`` of its own.

    Over an episode it comes to Σ_t d_t·h·(Σ_k a_k·f̄_k + Σ_i b_i·(x_i(t) + x_i(t + 1))/2 + Σ_c e_c·|u_c − n_c|), f̄ being
    mean flows, a the ``accounts`` of arcs and of the nodes that they enter, b the ``holding`` of nodes, e the
    ``effort`` of what controls u are away from their neutral values n, and d_t = (1 + r)^(−τ) the discount of what is
    booked in the middle of an interval, τ years after the start. Each rate may rise with what it is of
    (``PiecewiseRate``).
    """

    id: str
    title: Annotated[str, TITLE] = ""
    unit: Annotated[
        str,
        Declaration(
            "unit of its amounts, such as ``t CO2e``, ``GJ``, or ``EUR_2023``: a currency has the year of its prices",
            mandatory=True,
        ),
    ]
    discount: Annotated[float, Quantity("r, by which a year later counts less", low=-0.99, high=10.0)] = 0.0


@frozen_record
class Substance(CheckedRecord):
    """What is in the material, such as copper in steel, under an ``id`` of its own.

    Of a stock x it is a part x_e, and what is no substance is one too, x − Σ x_e. Each flows in the same proportion
    as the stock that it is in, but where a node separates them (``transfer``); what flows by schedule has the content
    of its donor at the start of a step of the solver, and a node without stock mixes what enters it.
    """

    id: str
    scale: Annotated[float, Positive("reference content of observations, a part of the mass")] = 1.0


@frozen_record
class Episode(CheckedRecord):
    """Time and solver of an episode."""

    control_interval: Annotated[float, Positive("h, time between two decisions", of="time", mandatory=True)] = 1.0
    horizon: Annotated[int, Quantity("decisions per episode", of="steps", low=1, high=10_000_000, mandatory=True)] = 50
    solver: Annotated[
        str,
        Word(
            "``exact`` (zero-order-hold solution, for networks without inner physics), ``rk4`` (classical Runge-Kutta, "
            "for those with it), both keeping stocks non-negative; or ``euler`` (the explicit step of the published "
            "environments; stocks may become negative)",
            of=("exact", "rk4", "euler"),
        ),
    ] = "exact"
    solver_step: Annotated[
        float | None,
        Quantity(
            "step of the ``rk4`` and ``euler`` solvers, a whole fraction of the control interval; the longest "
            "of ``exact``",
            of="time",
            joint=True,
        ),
    ] = None
    start: Annotated[
        float | date | None,
        CalendarTime(
            "when it begins on the calendar, a year such as 2000 or 2000.5, or a date; None if the calendar does not "
            "matter"
        ),
    ] = None


@frozen_record
class Objective(CheckedRecord):
    """How circularity and rewards are read off the network."""

    reference_interval: Annotated[float, Positive("Δ of λ = −(m_fb + Δ·ṁ_fc)", of="time", mandatory=True)] = 1.0
    net_zero: Annotated[
        str,
        Word(
            "``signed`` counts over-removal from the environment as positive; ``abs`` penalises it like emission",
            of=("signed", "abs"),
            mandatory=True,
        ),
    ] = "signed"
    reward: Annotated[str, Word("default reward mode of the environments", of=REWARDS, mandatory=True)] = "mixed"
    circularity_scale: Annotated[float, Positive("reference |λ|", of="mass", mandatory=True)] = 1.0
    circularity_weight: Annotated[
        float, Share("weight w of λ in ``mixed`` = w·λ/scale + (1 − w)·local", mandatory=True)
    ] = 0.5
    tracked: Annotated[
        tuple[str, ...],
        Declaration("compartments whose distance to the set-point enters their local reward; empty means all with one"),
    ] = ()
    criticality: Annotated[
        float | None,
        NotNegative("c of the material; evaluations then report the time-window circularity of CIRO7.2 too"),
    ] = None


@frozen_record
class Observation(CheckedRecord):
    """What agents see by default."""

    mode: Annotated[
        str,
        Word(
            "``local``, ``neighbours``, ``full``, ``stocks`` (the stocks of ``nodes`` in that order) or ``model`` "
            "(what the agent's own model shows, nothing else)",
            of=OBSERVE,
            label="observation mode",
            mandatory=True,
        ),
    ] = "local"
    nodes: Annotated[
        tuple[str, ...],
        Declaration("in mode ``stocks``, the observed stocks (ids of nodes) and inner states (``compartment.state``)"),
    ] = ()
    countdown: Annotated[
        bool, Declaration("whether agents also see 1/(intervals left), which tells the last ones apart")
    ] = False
