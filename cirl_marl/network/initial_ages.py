"""How old the stock of a node with a lifetime is at the start of an episode: the stages, or slots, that it is in."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from cirl_marl.network.elements import Lifetime, Node
from cirl_marl.network.lifetimes import Chain
from cirl_marl.network.rowsum import Floats
from cirl_marl.network.series import Series, Value, means
from cirl_marl.network.specification import Specification

STEEPEST = 100.0
"""Most by which the logarithm of what enters may grow in a lifetime."""


def slots(lifetime: Lifetime, interval: float) -> int:
    """Return how many control intervals a fixed lifetime takes."""
    return round(lifetime.mean / interval)


def remaining_history(node: Node, interval: float, content: Value = 1.0) -> Floats:
    """Return what is left of a node's history at the start of the episode, by stage or slot, mass.

    What enters is spread evenly over each interval before the start. Before the history it had grown by e^(g·t), so
    that the mean of an interval of length h before its first value is e^(−gh) of that, or it was nothing if the node
    states no ``growth``. Stages begin with the one with most to go, slots with the youngest; after them is what comes
    out, of which there is none between intervals. With a ``content`` it is that of a substance, which before the
    history had its first content.
    """
    lifetime, history, growth = node.lifetime, node.history, node.growth
    assert lifetime is not None and history is not None
    if lifetime.chain is None:
        return np.append(past_inflows(node, interval, slots(lifetime, interval), content), 0.0)
    return _remaining_stages(lifetime.chain, earlier_lifetime(node), history, growth, interval, content)


def earlier_lifetime(node: Node) -> float:
    """Return the mean lifetime before the episode."""
    assert node.lifetime is not None
    return node.lifetime.mean * node.history_stretch


@lru_cache(maxsize=1024)  # a network asks several times, and its scenarios do
def _remaining_stages(
    chain: Chain, mean: float, history: Series, growth: float | None, interval: float, content: Value
) -> Floats:
    edges = _past_edges(history, interval)
    stages = np.zeros(chain.stages)
    if growth is not None:
        stages = chain.growing_stock(growth * mean) * _first(history, growth, interval) * mean
        stages *= means(content, edges[:2])
    whole = propagator(chain, interval / mean)
    inflows = history.means(edges) * means(content, edges)
    for begin, end, inflow in zip(edges[:-1], edges[1:], inflows, strict=True):
        shorter = end - begin < interval * (1 - 1e-9)
        transition, gain = propagator(chain, (end - begin) / mean) if shorter else whole
        stages = transition @ stages + gain * inflow * mean
    stages.flags.writeable = False
    return stages


def _past_edges(history: Series, interval: float) -> Floats:
    """Return ends of intervals from when a history begins, of which the last may be short."""
    return np.append(np.arange(history.times[0], -1e-9 * interval, interval), 0.0)


def _slot_edges(history: Series, interval: float) -> Floats:
    """Return ends of the slots in which a history is, of which the first may be short."""
    return np.append(history.times[0], interval * np.arange(2.0 - len(_past_edges(history, interval)), 1.0))


def content_edges(network: Specification, node: Node) -> Floats:
    """Return the times between which contents of a node are stated: intervals of the episode, or of its history."""
    interval, horizon = network.episode.control_interval, network.episode.horizon
    if node.history is None:
        return np.arange(horizon + 1.0) * interval
    has_slots = node.lifetime is not None and node.lifetime.chain is None
    return _slot_edges(node.history, interval) if has_slots else _past_edges(node.history, interval)


def age_shares(node: Node, interval: float) -> Floats:
    """Return the part of its initial stock that is in each stage, or slot; they sum to 1.

    They are those of the history, or of a stock into which always more has flowed by e^(g·t); g is ``growth`` or 0.
    """
    lifetime, growth = node.lifetime, node.growth or 0.0
    assert lifetime is not None
    if node.history is not None:
        parts = remaining_history(node, interval)
    elif lifetime.chain is not None:
        parts = lifetime.chain.growing_stock(growth * earlier_lifetime(node))
    else:
        parts = np.append(np.exp(-growth * interval * np.arange(slots(lifetime, interval))), 0.0)
    return np.asarray(parts / parts.sum())


@lru_cache(maxsize=256)  # commodities and scenarios share lifetimes, and a matrix exponential takes milliseconds
def propagator(chain: Chain, time: float) -> tuple[Floats, Floats]:
    """Return what e^(A·t) does to the stages, shape (K, K), and what they get of an inflow of 1 in that time, (K,).

    Time is in units of the chain's ``mean``, and so is that of the inflow. Both arrays are read-only.
    """
    from scipy.linalg import expm

    size = chain.stages
    # the inflow as a constant last state: one exponential gives e^(At) and ∫e^(As)b ds (Van Loan 1978)
    system = np.zeros((size + 1, size + 1))
    system[:size, :size], system[:size, size] = chain.matrix, chain.inflow_shares
    exponential = expm(system * time)
    exponential.flags.writeable = False
    return exponential[:size, :size], exponential[:size, size]


def past_inflows(node: Node, interval: float, count: int, content: Value = 1.0) -> Floats:
    """Return the mass that entered in each of some intervals before the start, last first, shape (count,).

    Without a history it is relative to that of the last one; with one, a ``content`` makes it that of a substance.
    """
    if node.history is None:
        return np.asarray(np.exp(-(node.growth or 0.0) * interval * np.arange(count)))
    first = _first(node.history, node.growth, interval)
    times = [(-interval * (i + 1), -interval * i) for i in range(count)]
    return np.array([_between(node, first, *ends) * _past_content(node, interval, content, *ends) for ends in times])


def _first(history: Series, growth: float | None, interval: float) -> float:
    """Return what flowed in when the history begins, as if what grew before had come to it."""
    begin, growth = history.times[0], growth or 0.0
    first = float(history.means(np.array([begin, min(begin + interval, 0.0)]))[0])
    return first * growth * interval / float(np.expm1(growth * interval)) if growth else first


def _between(node: Node, first: float, begin: float, end: float) -> float:
    """Return the mass that entered between two times before the start."""
    assert node.history is not None
    start, mass = node.history.times[0], 0.0
    if end > start:
        since = max(begin, start)
        mass += float(node.history.means(np.array([since, end]))[0]) * (end - since)
    if begin < start and node.growth is not None:
        until = min(end, start)
        past, g = (begin - start, until - start), node.growth
        mass += first * (past[1] - past[0] if g == 0 else float(np.exp(g * past[1]) - np.exp(g * past[0])) / g)
    return mass


def _past_content(node: Node, interval: float, content: Value, begin: float, end: float) -> float:
    """Return the mean content of what entered between two times before the start; before the history its first."""
    assert node.history is not None
    start = node.history.times[0]
    until = end if end > start else float(_slot_edges(node.history, interval)[1])
    return float(means(content, np.array([max(begin, start), until]))[0])


def age_problems(node: Node, interval: float) -> Iterator[str]:
    """Yield why the ages of a node's initial stock cannot be told."""
    lifetime, history = node.lifetime, node.history
    assert lifetime is not None
    chain, growth, mean = lifetime.chain, node.growth or 0.0, earlier_lifetime(node)
    if abs(growth) * max(mean, interval) > STEEPEST:
        yield f"growth {growth:g}: in a lifetime of {mean:g} it makes too much of nothing; is it in percent?"
    elif chain is not None and node.growth is not None and node.growth * mean <= -chain.rate:
        yield (
            f"growth {node.growth:g}: no stock has a lifetime of {mean:g} and shrinks so fast; it must be "
            f"above {-chain.rate / mean:.4g}"
        )
    elif history is not None and remaining_history(node, interval).sum() <= 0:
        yield "history: nothing is left of it at the start of the episode"
