"""Numbers that nobody knows exactly: how they spread, and networks with numbers drawn from that."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from scipy import special

from cirl_marl.errors import unknown_name
from cirl_marl.network.declarations import CheckedRecord, Positive, Quantity, Word, declarations, frozen_record
from cirl_marl.network.elements import FIXED_LIFETIME, Arc, Law, Node, Service
from cirl_marl.network.rowsum import Floats
from cirl_marl.network.series import Series, extremes, in_intervals
from cirl_marl.network.specification import Specification
from cirl_marl.network.split_fractions import proportions, splits

WIDE = 4.0
"""Deviations of a normal distribution up to which every distribution goes that states no range, by probability."""
DISTRIBUTIONS = ("normal", "lognormal", "gamma", "uniform")
KINDS: Mapping[str, type[Any]] = {"nodes": Node, "arcs": Arc, "services": Service}
"""Parts of a network whose numbers may be uncertain, by the key of their table."""


@frozen_record
class Spread(CheckedRecord):
    """How a number spreads, as a factor on it: of mean or middle 1, the same at all times of an episode."""

    deviation: Annotated[
        float | None, Positive("standard deviation, relative to the number; None if it is uniform")
    ] = None
    low: Annotated[float, Quantity("lowest value, relative to the number", low=0.0)] = 0.0
    high: Annotated[float, Quantity("highest value, likewise", joint=True)] = math.inf
    distribution: Annotated[
        str,
        Word("``normal``, ``lognormal`` or ``gamma``, cut to the range, or ``uniform``", of=DISTRIBUTIONS),
    ] = "normal"

    def problems(self) -> Iterator[str]:
        """Yield why nothing can be drawn."""
        if not self.low < self.high:
            yield f"range [{self.low:g}, {self.high:g}], relative to the number, is empty; the lower end comes first"
        elif not self.low <= 1.0 <= self.high:
            yield f"range [{self.low:g}, {self.high:g}], relative to the number, does not contain the number itself"
        if self.distribution == "uniform" and (self.deviation is not None or math.isinf(self.high)):
            yield "distribution 'uniform' needs a range and no deviation"
        elif self.distribution != "uniform" and self.deviation is None:
            yield f"distribution '{self.distribution}' needs a deviation"

    @property
    def ends(self) -> tuple[float, float]:
        """Lowest and highest factor that can be drawn."""
        return (self.low, self.high) if self.deviation is None else self._ends(self.deviation)

    def at(self, share: Floats) -> Floats:
        """Return the factors below which these shares of all draws lie, in the shape of ``share``."""
        if self.deviation is None:
            return np.asarray(self.low + share * (self.high - self.low))
        low, high = self._ends(self.deviation)
        first, last = (self._below(end, self.deviation) for end in (low, high))
        factors: Floats = np.clip(self._factor(first + share * (last - first), self.deviation), low, high)
        return factors

    def _ends(self, deviation: float) -> tuple[float, float]:
        """Return the range, cut to where next to nothing is drawn."""
        widest = special.ndtr(np.array([-WIDE, WIDE]))
        least, most = self._factor(widest, deviation).tolist()
        return max(self.low, least), min(self.high, most)

    def _below(self, factor: float, deviation: float) -> float:
        """Return the probability of less than a factor."""
        if self.distribution == "gamma":
            return float(special.gammainc(deviation**-2, factor * deviation**-2))
        if self.distribution == "normal":
            return float(special.ndtr((factor - 1.0) / deviation))
        width = math.sqrt(math.log1p(deviation**2))
        return float(special.ndtr(math.log(factor) / width + width / 2)) if factor > 0 else 0.0

    def _factor(self, share: Floats, deviation: float) -> Floats:
        """Return what is less with these probabilities, before it is cut to the range."""
        if self.distribution == "gamma":
            return np.asarray(special.gammaincinv(deviation**-2, share) * deviation**2)
        if self.distribution == "normal":
            return np.asarray(1.0 + deviation * special.ndtri(share))
        width = math.sqrt(math.log1p(deviation**2))
        return np.asarray(np.exp(width * special.ndtri(share) - width**2 / 2))


def numbers_of(network: Specification, kind: str, field: str) -> dict[str, int]:
    """Return the rows of uncertain numbers among the factors, by the id of the part of which they are a field."""
    rows = {}
    for row, path in enumerate(network.uncertain):
        part_kind, id_, name = _split(path)
        if (part_kind, name) == (kind, field):
            rows[id_] = row
    return rows


def highest_factor(network: Specification, path: str) -> float:
    """Return the greatest factor on the number at a path; 1 if it is known exactly."""
    return float(network.uncertain[path].ends[1]) if path in network.uncertain else 1.0


def uncertainty_problems(network: Specification) -> Iterator[str]:
    """Yield why the numbers that are said to be uncertain cannot be drawn."""
    for path, spread in network.uncertain.items():
        try:
            part, name = _uncertain_field(network, path)
        except KeyError as error:
            yield f"{path}: {error.args[0]}"
            continue
        mistakes = list(spread.problems())
        if not mistakes and extremes(getattr(part, name)) == (0.0, 0.0):
            mistakes = ["it is 0, and so is every draw; give the number"]
        if not mistakes:
            mistakes = list(_undrawable(network, part, name, spread))
        yield from (f"{path}: {mistake}" for mistake in mistakes)


def _undrawable(network: Specification, part: Any, name: str, spread: Spread) -> Iterator[str]:
    """Yield why no network could have some of the draws."""
    if name == "rate" and isinstance(part, Arc) and part.law is Law.BATCH:
        yield "the mass of what is released in batches cannot be uncertain"
    elif name == "stretch" and (part.lifetime is None or part.lifetime.distribution == FIXED_LIFETIME):
        yield "only a lifetime with a deviation can be stretched"
    elif name == "stretch" and spread.ends[0] <= 0:
        yield "some draws are 0; give a range above it"
    elif isinstance(part, Service):
        low, high = (highest_factor(network, f"services.{part.id}.low"), 1.0)
        if f"services.{part.id}.high" in network.uncertain:
            high = network.uncertain[f"services.{part.id}.high"].ends[0]
        ends = network.interval_means(part.low) * low, network.interval_means(part.high) * high
        if (ends[0] > ends[1]).any():
            yield "some draws turn the band upside down; give ranges that do not overlap"


def draw_network(network: Any, factors: Sequence[float]) -> Any:
    """Return the network whose numbers are certain: those that were uncertain, times what was drawn.

    Shares of a donor stay shares of a whole: those that have no control keep their proportions to each other, and an
    arc that takes the rest gets what they leave, if anything. Sources without a known reserve keep that of ``network``.

    Args:
        network: with uncertain numbers.
        factors: of ``network.uncertain``, in their order.
    """
    changes: dict[int, tuple[Any, dict[str, Any]]] = {}

    def change(part: Any, name: str, value: Any) -> None:
        changes.setdefault(id(part), (part, {}))[1][name] = value

    for path, factor in zip(network.uncertain, factors, strict=True):
        part, name = _uncertain_field(network, path)
        value = getattr(part, name)
        if isinstance(value, Series):
            change(part, name, replace(value, values=tuple(part_ * float(factor) for part_ in value.values)))
        else:
            change(part, name, value * float(factor))
    for split in splits(network):
        arcs = [network.arcs[k] for k in split.other_arcs]
        shares_ = [changes.get(id(arc), (arc, {}))[1].get("share", arc.share) for arc in arcs]
        if any(value is not arc.share for value, arc in zip(shares_, arcs, strict=True)):
            drawn_shares = np.array([network.interval_means(np.nan if value is None else value) for value in shares_])
            remainder = 1.0 - split.bounds[1].sum(axis=0)
            for arc, shares in zip(arcs, proportions(drawn_shares, remainder) * remainder, strict=True):
                if arc.share is not None:
                    change(arc, "share", in_intervals(shares, network.episode.control_interval))
    initial: dict[str, Any] = dict(zip((node.id for node in network.stores), network.initial.T.tolist(), strict=True))
    for node in network.stores:
        if node.initial is None and node.history is None:
            change(node, "initial", tuple(initial[node.id]))

    def with_draws(part: Any) -> Any:
        return replace(part, **changes[id(part)][1]) if id(part) in changes else part

    groups = {key: tuple(map(with_draws, getattr(network, key))) for key in KINDS}
    return replace(network, **groups, uncertain={}, scenarios={})


def _uncertain_field(network: Specification, path: str) -> tuple[Any, str]:
    """Return the part and the name of the field at a path such as ``arcs.mining.rate``.

    Raises:
        KeyError: with what is wrong with the path.
    """
    kind, id_, name = _split(path)
    if kind not in KINDS:
        raise KeyError(f"only numbers of {', '.join(KINDS)} can be uncertain")
    parts = {part.id: part for part in getattr(network, kind)}
    if id_ not in parts:
        raise KeyError(unknown_name(kind[:-1], id_, parts))
    fields = declarations(KINDS[kind])
    options = [
        field
        for field, declaration in fields.items()
        if isinstance(declaration, Quantity) and declaration.varies and not declaration.past
    ]
    if name not in options:
        raise KeyError(f"of {kind} these can be uncertain: {', '.join(options)}; '{name}' cannot")
    if getattr(parts[id_], name) is None:
        raise KeyError(f"'{name}' is not given, so that nothing can be drawn")
    return parts[id_], name


def _split(path: str) -> tuple[str, str, str]:
    """Return kind, id and field of a path."""
    kind, _, rest = path.partition(".")
    id_, _, name = rest.rpartition(".")
    return kind, id_, name
