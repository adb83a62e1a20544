"""Numbers that change in time: what they are in a control interval, what is wrong with them, how they are written."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import quad

from cirl_marl import Arc, Control, Episode, Law, Network, NetworkError, Node, Role, Series, Service, load_network
from cirl_marl.definitions.reader import write_network
from cirl_marl.definitions.writer import definition_of, fingerprint
from cirl_marl.network.elements import ControlKind
from cirl_marl.network.series import extremes

STEPS = Series(times=(-3.0, 1.0, 2.5), values=(1.0, 3.0, 0.5))
LINES = Series(times=(0.0, 2.0, 6.0), values=(1.0, 3.0, 0.5), interpolation="linear")


def at(series: Series, time: float) -> float:
    """Return a series at a time, by its definition."""
    if series.interpolation == "linear":
        return float(np.interp(time, series.times, series.values))
    return [value for begins, value in zip(series.times, series.values, strict=True) if begins <= time][-1]


@given(
    gaps=st.lists(st.floats(0.05, 3.0), min_size=1, max_size=6),
    before=st.floats(0.0, 5.0),
    values=st.lists(st.floats(-10.0, 10.0), min_size=7, max_size=7),
    linear=st.booleans(),
    interval=st.floats(0.1, 2.0),
)
def test_means_are_integrals(
    gaps: list[float], before: float, values: list[float], linear: bool, interval: float
) -> None:
    """Over each interval, whatever breaks it, whenever the series begins."""
    times = tuple(np.cumsum([-before, *gaps]).tolist())
    series = Series(times=times, values=tuple(values[: len(times)]), interpolation="linear" if linear else "step")
    count = max(1, int((times[-1] if linear else times[-1] + 1.0) / interval))
    edges: NDArray[np.float64] = np.arange(count + 1, dtype=np.float64) * np.float64(interval)
    if linear and edges[-1] > times[-1]:
        edges = np.array([0.0, times[-1]]) if times[-1] > 0 else edges[:0]
    for mean, low, high in zip(series.means(edges) if len(edges) else (), edges, edges[1:], strict=False):
        breaks = [time for time in times if low < time < high]
        integral = quad(lambda time: at(series, time), low, high, points=breaks or None, limit=200)[0]
        assert mean == pytest.approx(integral / (high - low), abs=1e-9)


def test_a_constant_and_a_series_that_stays() -> None:
    """Are held alike."""
    network = replaced(flow=Series(times=(-1.0,), values=(7.0,)))
    np.testing.assert_array_equal(network.interval_means(network.arcs[0].flow), network.interval_means(7.0))
    assert extremes(STEPS) == (0.5, 3.0)
    assert extremes(2.0) == (2.0, 2.0)
    assert f"{STEPS:g}" == "0.5 … 3"


def replaced(horizon: int = 4, start: Any = None, **changes: Any) -> Network:
    """Return a network of one scheduled flow with these fields."""
    nodes = (Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR), Node(id="use", initial=(0.0, 0.0)))
    arc = Arc(id="ore", donor="mine", recipient="use", law=Law.EXOGENOUS, flow=1.0)
    episode = Episode(control_interval=1.0, horizon=horizon, start=start)
    return Network(name="ores", nodes=nodes, arcs=(replace(arc, **changes),), episode=episode, time_unit="year")


@pytest.mark.parametrize(
    ("series", "said"),
    [
        (Series(times=(), values=()), "series has 0 times and 0 values: one for each"),
        (Series(times=(0.0,), values=(1.0, 2.0)), "series has 1 times and 2 values: one for each"),
        (Series(times=(0.0, 0.0), values=(1.0, 2.0)), "times must increase and be finite, but 0 follows 0"),
        (Series(times=(0.0, math.inf), values=(1.0, 2.0)), "times must increase and be finite, but inf follows 0"),
        (Series(times=(0.0,), values=(math.nan,)), "series: times and values must be finite"),
        (Series(times=(0.0, 1e200), values=(1.0, 2.0)), "must be at most 1e+50 in size, but 1e+200 stands there"),
        (Series(times=(0.0, 1e-300), values=(1.0, 2.0)), "series: times must be at least 1e-50 apart"),
        (Series(times=(0.0, 2.0), values=(1.0, 2.0), until=1.0), "until 1 lies before its last time, 2"),
        (
            Series(times=(0.5,), values=(1.0,)),
            "series begins at 0.5 (2000.5), after the episode does; it needs a value for 0 (2000)",
        ),
        (
            Series(times=(0.0, 3.0), values=(1.0, 2.0), interpolation="linear", origin="x.csv"),
            "series ends at 3 (2003), but the episode at 4 (2004); give what is missing, or a shorter horizon (x.csv)",
        ),
        (Series(times=(0.0,), values=(1.0,), until=3.0), "series ends at 3 (2003), but the episode at 4 (2004)"),
        (Series(times=(0.0,), values=(-1.0,)), "flow -1.0 must be finite and not negative"),
    ],
)
def test_series_that_are_none(series: Series, said: str) -> None:
    """Each is told with its arc, and on the calendar if there is one."""
    with pytest.raises(NetworkError) as raised:
        replaced(start=2000, flow=series)
    assert "arc 'ore': " in str(raised.value)
    assert said in str(raised.value)


def test_series_are_written_and_read_to_the_last_bit(tmp_path: Path) -> None:
    """In every field that may hold one, with and without what is by default; where it was read from does not count."""
    series = Series(times=(-1 / 3, 0.1, 2.0), values=(0.1, 1 / 3, 0.7), until=5.0)
    lines = Series(times=(0.0, 4.0), values=(0.2, 1 / 7), interpolation="linear")
    control = Control(kind=ControlKind.SHARE, low=lines, neutral=0.25, high=Series(times=(0.0, 1.0), values=(0.5, 0.6)))
    network = replace(
        replaced(flow=series),
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR),
            Node(id="use", initial=(1.0, 2.0), rate=lines),
            Node(id="market", stores=False, set_point=0.5, scale=3.0),
            Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="ore", donor="mine", recipient="market", law=Law.EXOGENOUS, flow=series),
            Arc(id="sold", donor="market", recipient="use", law=Law.SHARE, control=control),
            Arc(id="lost", donor="market", recipient="dump", law=Law.SHARE),
            Arc(id="back", donor="use", recipient="market", law=Law.SHARE, share=lines),
            Arc(id="away", donor="use", recipient="dump", law=Law.SHARE),
        ),
        services=(Service(id="need", provider="use", quantity="stock", low=series, high=5.0),),
        episode=Episode(horizon=4, start=2000.5),
        material="ore",
        references=("one", "two"),
    )
    write_network(network, tmp_path / "ores.toml")
    assert load_network(tmp_path / "ores.toml") == network
    elsewhere = replace(network, arcs=(replace(network.arcs[0], flow=replace(series, origin="x")), *network.arcs[1:]))
    assert elsewhere == network
    assert fingerprint(elsewhere) == fingerprint(network)
    assert fingerprint(replace(network, arcs=(replaced().arcs[0], *network.arcs[1:]))) != fingerprint(network)


def test_what_is_by_default_is_not_written() -> None:
    """Steps that hold for good have times and values alone."""
    text = definition_of(replaced(flow=STEPS))
    assert "flow = {times = [-3.0, 1.0, 2.5], values = [1.0, 3.0, 0.5], time_unit" in text
    assert "start" not in text


def test_material_and_references_count_for_no_result() -> None:
    """Like the title they are kept, and change no fingerprint."""
    network = replaced()
    assert network.material == "not stated"
    other = replace(network, material="ore", references=("a book",), title="Ores")
    assert fingerprint(other) == fingerprint(network)
    assert fingerprint(replaced(start=2000)) == fingerprint(replaced(start=2000.0)) != fingerprint(network)


@given(st.data())
def test_means_keep_to_the_values_that_they_are_of(data: st.DataObject) -> None:
    """What holds throughout an interval is its mean to the bit; no mean leaves the range of its values."""
    knots = data.draw(st.lists(st.integers(1, 39), max_size=6, unique=True).map(sorted))
    number = st.sampled_from([0.0, 0.1, 0.3, 0.7, 33.3]) | st.floats(0.0, 1e6)
    values = [data.draw(number) for _ in range(len(knots) + 2)]
    kind = data.draw(st.sampled_from(["step", "linear"]))
    shift = data.draw(st.sampled_from([0.0, 4e-15, 0.5]))
    times = (0.0, *(knot + shift for knot in knots), 41.0)
    means = Series(times=times, values=tuple(values), interpolation=kind).means(np.arange(41.0))
    assert means.min() >= min(values)
    assert means.max() <= max(values)
    if kind == "step" and shift != 0.5:
        place = np.searchsorted(times, np.arange(40.0) + 0.5) - 1
        held = np.array(values)[place]
        same = np.ones(40, dtype=bool) if shift == 0.0 else ~np.isin(np.arange(40), knots)
        assert (means[same] == held[same]).all()


@pytest.mark.parametrize("kinds", [("step", "step"), ("step", "linear"), ("linear", "linear")])
def test_a_product_has_the_mean_of_the_product(kinds: tuple[str, str]) -> None:
    """Not the product of the means; against a fine sum, with times that fall together and others that do not."""
    rng = np.random.default_rng(5)
    times = [(0.0, 1.5, 4.0, 6.5), (-1.0, 1.5, 2.25, 7.0)]
    per_head, heads = (
        Series(times=each, values=tuple(rng.uniform(1, 9, 4).tolist()), interpolation=kind)
        for each, kind in zip(times, kinds, strict=True)
    )
    product = replace(per_head, factor=heads)
    edges = np.array([0.0, 0.7, 2.0, 2.25, 5.0, 6.5])
    fine = np.linspace(0.0, 6.5, 130_001)
    middles = (fine[:-1] + fine[1:]) / 2
    both = per_head.limits(middles, "right") * heads.limits(middles, "right")
    expected = [both[(middles > a) & (middles < b)].mean() for a, b in pairwise(edges.tolist())]
    np.testing.assert_allclose(product.means(edges), expected, rtol=1e-4)
    low, high = product.extremes
    assert low <= both.min() and both.max() <= high
    assert abs(product.means(edges) - per_head.means(edges) * heads.means(edges)).max() > 1e-3


def test_a_factor_covers_what_it_multiplies() -> None:
    """Nothing is told of the time before it begins."""
    late = Series(times=(-2.0, 0.0), values=(1.0, 8.0), interpolation="linear")
    history = Series(times=(-30.0, 0.0), values=(1.0, 1.0), interpolation="linear", factor=late)
    assert "series begins at -2, after what it multiplies at -30" in history.history_problem()
    assert history.coverage_problem(3.0)
    assert replace(history, factor=replace(late, times=(-31.0, 0.0))).history_problem() == ""
