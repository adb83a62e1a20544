"""Numbers that nobody knows exactly: how they spread, and networks with numbers drawn from that."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from scipy import stats

from cirl_marl.errors import unknown
from cirl_marl.network.declared import Checked, Positive, Quantity, Word, declarations, frozen
from cirl_marl.network.elements import Arc, Node, Service
from cirl_marl.network.parts import Parts
from cirl_marl.network.rowsum import Floats
from cirl_marl.network.series import Series, extremes
from cirl_marl.network.splits import splits

WIDE = 4.0
"""Deviations up to which a normal distribution goes if it states no range."""
DISTRIBUTIONS = ("normal", "lognormal", "uniform")
KINDS: Mapping[str, type[Any]] = {"nodes": Node, "arcs": Arc, "services": Service}
"""Parts of a network whose numbers may be uncertain, by the key of their table."""


@frozen
class Spread(Checked):
    """How a number spreads, as a factor on it: of mean or middle 1, the same at all times of an episode."""

    deviation: Annotated[
        float | None, Positive("standard deviation, relative to the number; None if it is uniform")
    ] = None
    low: Annotated[float, Quantity("lowest value, relative to the number", low=0.0)] = 0.0
    high: Annotated[float, Quantity("highest value, likewise", joint=True)] = math.inf
    distribution: Annotated[
        str,
        Word("``normal`` or ``lognormal``, cut to the range, or ``uniform``", of=("normal", "lognormal", "uniform")),
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

    def at(self, share: Floats) -> Floats:
        """Return the factors below which these shares of all draws lie, in the shape of ``share``."""
        if self.deviation is None:
            return np.asarray(self.low + share * (self.high - self.low))
        low, high = self.low, self.high
        if self.distribution == "normal":
            law = stats.norm(1.0, self.deviation)
            low, high = max(low, 1 - WIDE * self.deviation), min(high, 1 + WIDE * self.deviation)
        else:
            width = math.sqrt(math.log1p(self.deviation**2))
            law = stats.lognorm(width, scale=math.exp(-(width**2) / 2))
        first, last = law.cdf(low), law.cdf(high)
        found: Floats = np.clip(law.ppf(first + share * (last - first)), low, high)
        return found


def uncertainty_problems(network: Parts) -> Iterator[str]:
    """Yield why the numbers that are said to be uncertain cannot be drawn."""
    for where, spread in network.uncertain.items():
        try:
            part, name = _found(network, where)
        except KeyError as error:
            yield f"{where}: {error.args[0]}"
            continue
        mistakes = list(spread.problems())
        if not mistakes and extremes(getattr(part, name)) == (0.0, 0.0):
            mistakes = ["it is 0, and so is every draw; give the number"]
        yield from (f"{where}: {each}" for each in mistakes)


def drawn(network: Any, shares: Sequence[float]) -> Any:
    """Return a network whose uncertain numbers lie where these shares of all draws are below them.

    Shares of a donor that sum to 1 are divided by their sum, others are cut so that they leave nothing less than none.

    Args:
        network: with uncertain numbers.
        shares: in [0, 1], one for each of ``network.uncertain``, in their order.
    """
    changed: dict[int, tuple[Any, dict[str, Any]]] = {}
    for (where, spread), share in zip(network.uncertain.items(), shares, strict=True):
        part, name = _found(network, where)
        factor, value = float(spread.at(np.float64(share))), getattr(part, name)
        if isinstance(value, Series):
            value = replace(value, values=tuple(each * factor for each in value.values))
        else:
            value *= factor
        changed.setdefault(id(part), (part, {}))[1][name] = value
    _share_out(network, changed)
    groups = {
        key: tuple(
            replace(each, **changed[id(each)][1]) if id(each) in changed else each for each in getattr(network, key)
        )
        for key in KINDS
    }
    return replace(network, **groups, uncertain={}, scenarios={})


def _share_out(network: Parts, changed: dict[int, tuple[Any, dict[str, Any]]]) -> None:
    """Scale drawn shares of a donor so that they are shares of a whole."""
    for split in splits(network):
        arcs = [network.arcs[k] for k in split.others]
        told = {id(arc): changed.get(id(arc), (arc, {}))[1].get("share", arc.share) for arc in arcs}
        if not any("share" in changed.get(key, (None, {}))[1] for key in told):
            continue
        given = [value for value in told.values() if value is not None]
        held = np.sum([network.held(value) for value in given], axis=0)
        room = 1.0 - network.held(0.0) - split.bounds[1].sum(axis=0)
        over = float((held / np.maximum(room, 1e-300)).max())
        if len(given) == len(told) or over > 1.0:
            for arc in arcs:
                value = told[id(arc)]
                if value is not None:
                    scaled = (
                        replace(value, values=tuple(each / over for each in value.values))
                        if isinstance(value, Series)
                        else value / over
                    )
                    changed.setdefault(id(arc), (arc, {}))[1]["share"] = scaled


def _found(network: Parts, where: str) -> tuple[Any, str]:
    """Return the part and the name of the field at a path such as ``arcs.mining.rate``.

    Raises:
        KeyError: with what is wrong with the path.
    """
    kind, _, rest = where.partition(".")
    id_, _, name = rest.partition(".")
    if kind not in KINDS:
        raise KeyError(f"only numbers of {', '.join(KINDS)} can be uncertain")
    parts = {part.id: part for part in getattr(network, kind)}
    if id_ not in parts:
        raise KeyError(unknown(kind[:-1], id_, parts))
    declared = declarations(KINDS[kind])
    known = [each for each, told in declared.items() if isinstance(told, Quantity) and told.varies and not told.past]
    if name not in known:
        raise KeyError(f"of {kind} these can be uncertain: {', '.join(known)}; '{name}' cannot")
    if getattr(parts[id_], name) is None:
        raise KeyError(f"'{name}' is not given, so that nothing can be drawn")
    return parts[id_], name
