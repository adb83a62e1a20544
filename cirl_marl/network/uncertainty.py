"""Numbers that nobody knows exactly: how they spread, and networks with numbers drawn from that."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from scipy import special

from cirl_marl.errors import unknown_name
from cirl_marl.network.declarations import (
    CheckedRecord,
    Positive,
    Quantity,
    Word,
    frozen_record,
    number_of,
    numbers,
    with_number,
)
from cirl_marl.network.elements import FIXED_LIFETIME, Arc, Compartment, Control, ControlKind, Law, Node, Service
from cirl_marl.network.initial_ages import content_edges
from cirl_marl.network.rowsum import Floats, Integers, single_column
from cirl_marl.network.series import Series, Value, extremes, in_intervals, means, product, series_of
from cirl_marl.network.specification import Specification
from cirl_marl.network.split_fractions import ROUNDING, Split, proportions, splits, trap_problems
from cirl_marl.network.substances import (
    CONTENT,
    arc_of_substance,
    is_past,
    network_of_substance,
    separated_substances,
    separates,
)

WIDE = 4.0
"""Deviations of a normal distribution up to which every distribution goes that states no range, by probability."""
DISTRIBUTIONS = ("normal", "lognormal", "gamma", "uniform")
CERTAIN = (1.0, 1.0)
"""Range of the factor on a number that is certain."""
KINDS: Mapping[str, type[Any]] = {"nodes": Node, "arcs": Arc, "services": Service}
"""Parts of a network whose numbers may be uncertain, by the key of their table."""
CAPACITY = "control.high"
"""What a disturbance may lower, or raise, of an actuator, as the last part of a path: its upper bound."""


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
        return np.asarray(np.clip(self._factor(first + share * (last - first), self.deviation), low, high))

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


def factor_ranges(network: Specification, *, with_draws: bool) -> dict[str, tuple[float, float]]:
    """Return the lowest and the highest factor on each number that is not certain, by path, in the order of factors.

    First come the numbers of ``network.uncertain``, if the episode draws them, then those that are only disturbed.
    """
    paths = [*network.uncertain, *network.disturbed] if with_draws else network.disturbed
    return {path: _factor_range(network, path, with_draws=with_draws) for path in paths}


def _factor_range(network: Specification, path: str, *, with_draws: bool = True) -> tuple[float, float]:
    low, high = network.uncertain[path].ends if with_draws and path in network.uncertain else CERTAIN
    if path not in network.disturbed:
        return low, high
    disturbed = network.disturbed[path]
    ends = network.disturbances[disturbed.by].ends
    if not disturbed.adds:
        return min(low * ends[0], high * ends[0]), high * ends[1]
    with np.errstate(divide="ignore"):  # of a number that is 0 no factor is finite, which is refused
        parts = disturbed.scale / stated_means(network, path)
    corners = [end * float(part) for end in ends for part in (parts.min(), parts.max())]
    return low + min(corners), high + max(corners)


def stated_means(network: Specification, path: str) -> Floats:
    """Return the number at a path as it is stated, its mean in each control interval, shape (horizon,)."""
    return network.interval_means(_number(*_uncertain_field(network, path)))


def numbers_of(paths: Iterable[str], kind: str, field: str) -> dict[str, int]:
    """Return the rows of those ``paths`` that are a field of a kind of part, by the id of the part."""
    rows = {}
    for row, path in enumerate(paths):
        part_kind, id_, name = _split(path)
        if (part_kind, name) == (kind, field):
            rows[id_] = row
    return rows


def uncertainty_problems(network: Specification) -> Iterator[str]:
    """Yield why the numbers that are said to be uncertain or disturbed cannot be drawn."""
    for path in dict.fromkeys([*network.uncertain, *network.disturbed]):
        try:
            part, name = _uncertain_field(network, path)
        except KeyError as error:
            yield f"{path}: {error.args[0]}"
            continue
        mistakes, number = [], _number(part, name)
        if path in network.uncertain:
            mistakes = list(network.uncertain[path].problems())
        if not mistakes and not all(map(math.isfinite, extremes(number))):
            mistakes = ["it is infinite, and so is every draw; give the number"]
        if not mistakes and extremes(number) == (0.0, 0.0):
            mistakes = ["it is 0, and so is every draw; give the number"]
        if not mistakes and path in network.disturbed and network.disturbed[path].adds:
            if (stated_means(network, path) <= 0).any():
                mistakes = ["a disturbance is added only to what is positive at all times; disturb it by a factor"]
        if not mistakes:
            mistakes = list(_undrawable(network, part, name, path))
        yield from (f"{path}: {mistake}" for mistake in mistakes)
    if any(path.endswith(".control") for path in network.uncertain):
        yield from _split_problems(network)


def _split_problems(network: Specification) -> Iterator[str]:
    """Yield donors whose shares some draws of their controls spoil."""
    ranges = {path: spread.ends for path, spread in network.uncertain.items() if not list(spread.problems())}
    highest = {id_: [*ranges.values()][row][1] for id_, row in numbers_of(ranges, "arcs", "control").items()}
    for substance in ("", *separated_substances(network)):
        of_substance = network_of_substance(network, substance) if substance else network
        divisions, subject = splits(of_substance), f"substance '{substance}': " if substance else ""
        if any(list(split.problems()) for split in divisions):
            return  # which is told elsewhere
        for split in divisions:
            factors = np.array([[highest.get(network.arcs[k].id, 1.0)] for k in split.controlled_arcs])
            most = float((split.bounds[1] * factors).sum(axis=0).max(initial=0.0)) if len(factors) else 0.0
            if (factors != 1).any() and most > 1 + ROUNDING:
                fault = f"some draws of its neutral shares sum to {most:.4g}, more than 1: give lower 'high'"
                yield f"{subject}node '{split.donor}': {fault}"
                return
        yield from (f"{subject}{fault}" for fault in trap_problems(of_substance, widest_splits(of_substance, ranges)))


def _undrawable(network: Specification, part: Any, name: str, path: str) -> Iterator[str]:
    """Yield why no network could have some of the draws."""
    disturbed, low = network.disturbed.get(path), _factor_range(network, path)[0]
    if name == "control" and disturbed is not None:
        yield f"'{disturbed.by}' can disturb '{CAPACITY}', not all of a control"
    elif name == "control" and f"{path}.high" in network.disturbed:
        yield "a control is uncertain or its capacity is disturbed, not both"
    elif name == "control" and part.control.kind is ControlKind.INPUT:
        yield "what is put into a model cannot be uncertain"
    elif name == "control" and part.control.kind is ControlKind.STRETCH and low <= 0:
        yield "some draws are 0; give a range above it"
    elif name == "rate" and isinstance(part, Arc) and part.law is Law.BATCH:
        yield "the mass of what is released in batches cannot be uncertain"
    elif name == "stretch" and (part.lifetime is None or part.lifetime.distribution == FIXED_LIFETIME):
        yield f"only a lifetime with a deviation can be stretched{' or disturbed' if disturbed else ''}"
    elif name == "stretch" and low <= 0:
        yield "some draws are 0; give a range above it"
    elif name.startswith(CONTENT) and (mistake := _no_content(network, part, path)):
        yield mistake
    elif name == CAPACITY and (mistake := _lost_capacity(network, part, path)):
        yield mistake
    elif low < 0:
        by = f"disturbed by '{disturbed.by}' " if disturbed else ""
        yield f"{by}it may be {low:.3g} times what is stated; it cannot be negative: give a higher 'low'"
    elif isinstance(part, Service):
        paths = [f"services.{part.id}.{end}" for end in ("low", "high")]
        if network.uncertain.keys() & set(paths) or not _move_together(network, *paths):
            bands = [network.interval_means(end) for end in (part.low, part.high)]
            if all(((band > 0) & np.isfinite(band)).all() for band in bands):  # else an end is told that is none
                bands[0] = bands[0] * _factor_range(network, paths[0])[1]
                bands[1] = bands[1] * _factor_range(network, paths[1])[0]
            if (bands[0] > bands[1]).any():
                by = f"disturbed by '{disturbed.by}': " if disturbed else ""
                yield f"{by}some draws turn the band upside down; give ranges that do not overlap"


def _no_content(network: Specification, node: Node, path: str) -> str:
    """Return why the contents of a node cannot be drawn or disturbed, or nothing."""
    if path in network.disturbed and is_past(node, CONTENT):
        return "what is in a stock at the start cannot be disturbed in time, but drawn"
    edges = content_edges(network, node)
    parts = [
        means(part, edges) * _factor_range(network, f"nodes.{node.id}.{CONTENT}{id_}")[1]
        for id_, part in dict(node.content).items()
    ]
    most = float(np.max(sum(parts)))
    by = f"disturbed by '{network.disturbed[path].by}': " if path in network.disturbed else ""
    if most <= 1 + ROUNDING:
        return ""
    return f"{by}some draws of its contents sum to {most:.4g}, more than 1: end its range, or 'high', lower"


def _lost_capacity(network: Specification, part: Any, path: str) -> str:
    """Return why the upper bound of a control cannot be disturbed, or nothing."""
    control = part.control
    remedies = {
        ControlKind.TRANSFER: "shares are parts of a whole; disturb an uncontrolled transfer",
        ControlKind.SHARE: "shares are parts of a whole; disturb an uncontrolled share, or what the donor releases",
        ControlKind.STRETCH: "disturb the stretch of the node",
        ControlKind.INPUT: "the input of a model is no capacity",
    }
    if path in network.uncertain:
        return "the bound of a control can be disturbed in time, but not drawn"
    if control.kind in remedies:
        return f"a control of kind '{control.kind}' has no capacity: {remedies[control.kind]}"
    lowest, most = network.interval_means(control.low), network.interval_means(control.high)
    worst = int(np.argmin(most * _factor_range(network, path)[0] - lowest))
    capacity = float(most[worst]) * _factor_range(network, path)[0]
    if capacity < lowest[worst]:
        by = network.disturbed[path].by
        return f"disturbed by '{by}' it may be {capacity:.3g}, below control.low {lowest[worst]:.3g}; lower that"
    return ""


def _move_together(network: Specification, low: str, high: str) -> bool:
    """Whether one disturbance moves both ends of a band alike, so that it never turns."""
    return low in network.disturbed and network.disturbed[low] == network.disturbed.get(high)


def draw_network(network: Any, factors: Sequence[float] = (), path: Floats | None = None) -> Any:
    """Return the network whose numbers are certain: those that were uncertain, times what was drawn.

    What is disturbed becomes a series. Of a control low, neutral and high value are multiplied, a share up to 1.
    Shares of a donor stay shares of a whole: those that have no control keep their proportions to each other, and an
    arc that takes the rest gets what they leave, if anything. Sources without a known reserve keep that of ``network``.

    Args:
        network: with uncertain or disturbed numbers.
        factors: of ``network.uncertain``, in their order; none leave them as they are stated.
        path: what disturbances are in each control interval, in the rows of ``network.processes``, shape (horizon,
            names); if something is disturbed. What they are expected to be gives the network that is expected.
    """
    changes: dict[int, tuple[Any, dict[str, Any]]] = {}
    interval = network.episode.control_interval

    def change(part: Any, name: str, value: Any) -> None:
        if name == CAPACITY:  # who stays neutral takes at most what there is
            neutral = np.minimum(network.interval_means(part.control.neutral), network.interval_means(value))
            name, value = "control", replace(part.control, high=value, neutral=in_intervals(neutral, interval))
        before = changes.get(id(part), (part, {}))[1]
        changes[id(part)] = part, with_number(part, name, value, before)

    drawn = dict(zip(network.uncertain, factors, strict=True)) if len(factors) else {}
    for number, factor in drawn.items():
        part, name = _uncertain_field(network, number)
        if name == "control":
            most = 1.0 if part.control.kind in (ControlKind.SHARE, ControlKind.TRANSFER) else math.inf
            sides = {side: getattr(part.control, side) for side in ("low", "neutral", "high")}
            drawn_sides = {side: _times(network, value, float(factor), most) for side, value in sides.items()}
            change(part, name, replace(part.control, **drawn_sides))
        else:
            change(part, name, _times(network, number_of(part, name), float(factor)))
    for number, disturbed in network.disturbed.items():
        assert path is not None
        (part, name), stated = _uncertain_field(network, number), stated_means(network, number)
        course = path[: len(stated), network.processes.names.index(disturbed.by)]
        value = stated * drawn.get(number, 1.0)
        course = value + disturbed.scale * course if disturbed.adds else value * course
        change(part, name, _course(name, course, interval))

    def drawn_arc(k: int) -> Any:
        arc = network.arcs[k]
        return replace(arc, **changes[id(arc)][1]) if id(arc) in changes else arc

    for k, name, share in [*_drawn_shares(network, drawn_arc)]:
        change(network.arcs[k], name, share)
    initial: dict[str, Any] = dict(zip((node.id for node in network.stores), network.initial.T.tolist(), strict=True))
    for node in network.stores:
        if node.initial is None and node.history is None:
            change(node, "initial", tuple(initial[node.id]))
    for part in (*network.nodes, *network.arcs):
        if part.rule is not None:
            change(part, "rule", None)  # it follows disturbances, which there are no more

    def with_draws(part: Any) -> Any:
        return replace(part, **changes[id(part)][1]) if id(part) in changes else part

    groups = {key: tuple(map(with_draws, getattr(network, key))) for key in KINDS}
    certain: dict[str, Any] = {"uncertain": {}, "disturbances": {}, "disturbed": {}, "correlation": None}
    return network.variant(**groups, **certain)


def _drawn_shares(network: Any, drawn_arc: Callable[[int], Any]) -> Iterator[tuple[int, str, Any]]:
    """Yield the shares of arcs, by number and field, of splits of which something was drawn, as parts of a whole.

    Where the share of all else changes, substances that a node separates keep theirs, which is then stated.
    """
    changed = set[int]()
    for substance in ("", *separated_substances(network)):
        of_substance = network_of_substance(network, substance) if substance else network
        field = f"transfer.{substance}" if substance else "share"
        for split in splits(of_substance):
            arcs: list[list[Any]] = [
                [arc_of_substance(drawn_arc(k), substance) for k in ks]
                for ks in (split.other_arcs, split.controlled_arcs)
            ]
            free, controlled = arcs
            parts = [*(arc.share for arc in free), *(arc.control for arc in controlled)]
            before = [of_substance.arcs[k].share for k in split.other_arcs]
            before += [of_substance.arcs[k].control for k in split.controlled_arcs]
            if parts == before and changed.isdisjoint(split.other_arcs):
                continue
            if substance and not separates(network, split):
                continue
            shares = np.array([network.interval_means(np.nan if arc.share is None else arc.share) for arc in free])
            remainder = 1.0 - split.bounds[1].sum(axis=0)
            left = 1.0 - sum((network.interval_means(arc.control.neutral) for arc in controlled), 0.0 * remainder)
            for k, arc, share in zip(split.other_arcs, free, proportions(shares, remainder) * left, strict=True):
                if arc.share is not None:
                    changed.add(k)
                    yield k, field, in_intervals(share, network.episode.control_interval)


def network_of_intervals(network: Any, intervals: Integers) -> Any:
    """Return the network with other control intervals, of which interval j is as ``intervals[j]`` of its own.

    Histories and disturbances stay as they are.
    """
    length = network.episode.control_interval

    def part_of_intervals(part: Any) -> Any:
        series: dict[str, Any] = {}
        for name, declaration, value in numbers(part):
            if isinstance(value, Series) and not (getattr(declaration, "past", False) or is_past(part, name)):
                chosen = _course(name, network.interval_means(value)[intervals], length)
                series = with_number(part, name, chosen, series)
        if getattr(part, "control", None) is not None:
            series["control"] = part_of_intervals(part.control)
        return replace(part, **series)

    groups = {key: tuple(map(part_of_intervals, getattr(network, key))) for key in KINDS}
    return network.variant(**groups, episode=replace(network.episode, horizon=len(intervals)))


def _course(name: str, values: Floats, interval: float) -> Value:
    """Return the number ``name`` that has these values: a series of what stands still, which nobody forgot, too.

    So are contents, as a source whose contents change has reserves of them.
    """
    value = in_intervals(values, interval)
    return series_of(values, interval) if value == 0.0 or name.startswith(CONTENT) else value


def _times(network: Specification, value: Value, factor: float, most: float = math.inf) -> Value:
    """Return a number times ``factor``, at most ``most`` in each control interval."""
    if not isinstance(value, Series):
        return min(value * factor, most)
    if extremes(value)[1] * factor > most:
        means = np.minimum(network.interval_means(value) * factor, most)
        return in_intervals(means, network.episode.control_interval)
    return product(value, factor)


def widest_splits(network: Specification, ranges: Mapping[str, tuple[float, float]]) -> list[Split]:
    """Return the splits of a network, with shares that controls set as low and as high as they can be drawn."""
    numbers, ends = numbers_of(ranges, "arcs", "control"), [*ranges.values()]
    divisions = []
    for split in splits(network):
        ids = [network.original(network.arcs[k].id) for k in split.controlled_arcs]
        if numbers.keys() & set(ids):
            drawn = [ends[numbers[id_]] if id_ in numbers else CERTAIN for id_ in ids]
            low, high = np.array(drawn, dtype=float).T[..., None]
            bounds = single_column(split.bounds) * np.stack([low, np.ones_like(low), high])
            split = replace(split, bounds=np.broadcast_to(np.minimum(bounds, 1.0), split.bounds.shape))
        divisions.append(split)
    return divisions


def expected_network(network: Any) -> Any:
    """Return the certain network in which disturbances are what they are expected to be before anything is known.

    A network without disturbances is returned as it is.
    """
    if not network.disturbed:
        return network
    return draw_network(network, (), network.processes.prior_means(network.episode.horizon))


def _uncertain_field(network: Specification, path: str) -> tuple[Any, str]:
    """Return the part and the name of the field at a path such as ``arcs.mining.rate``.

    Raises:
        KeyError: with what is wrong with the path.
    """
    kind, id_, name = _split(path)
    if kind not in KINDS:
        raise KeyError(f"only numbers of {', '.join(KINDS)} can be uncertain or disturbed")
    parts = {part.id: part for part in getattr(network, kind)}
    if id_ not in parts:
        raise KeyError(unknown_name(kind[:-1], id_, parts))
    options = [
        field
        for field, declaration, _ in numbers(parts[id_])
        if isinstance(declaration, Quantity) and declaration.varies and not declaration.past
    ]
    if isinstance(parts[id_], Compartment):
        options += ["control", CAPACITY]
    if name.startswith(CONTENT) and kind == "nodes" and name not in options:
        substances = [substance.id for substance in network.substances]
        if (id_of := name.removeprefix(CONTENT)) not in substances:
            raise KeyError(f"content: {unknown_name('substance', id_of, substances)}")
        raise KeyError(f"'{name}' is not stated, so that nothing can be drawn")
    if name not in options:
        raise KeyError(unknown_name(f"number of {kind} that can be uncertain or disturbed", name, options))
    if name == CAPACITY and parts[id_].control is None:
        raise KeyError("it has no control")
    if _number(parts[id_], name) is None:
        raise KeyError(f"'{name}' is not given, so that nothing can be drawn")
    return parts[id_], name


def _number(part: Any, name: str) -> Value:
    """Return the number that is uncertain or disturbed; of a control what its deviation is of, or its upper bound."""
    value = part.control.high if name == CAPACITY else number_of(part, name)
    return value.nominal if isinstance(value, Control) else value


def _split(path: str) -> tuple[str, str, str]:
    kind, id_, name = [*path.split(".", 2), "", ""][:3]
    return kind, id_, name
