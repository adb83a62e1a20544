"""What tables and pictures say of figures: signs, order, what is relative to what, and which is which."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.table import Table

from cirl_marl import Arc, Episode, Law, Network, Node, Series, Service, load_task
from cirl_marl.controllers.pyramids import Pyramid
from cirl_marl.evaluation.calibration import CLOSE
from cirl_marl.network.elements import Role
from cirl_marl.report import (
    account_tables,
    benchmark_tables,
    decisions,
    differences,
    objective_weights,
    page_data,
    samples,
    terminal,
    tradeoffs,
    trajectory,
)
from cirl_marl.suite.result_rows import ResultRow


def loop() -> Network:
    """Return a product that is made of ore, some of which goes back to where it came from."""
    flows = {"dug": ("ore", "use"), "kept": ("use", "use_again"), "returned": ("use", "ore")}
    return Network(
        name="loop",
        nodes=(
            Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR, initial=(9.0, 9.0)),
            Node(id="use", initial=(1.0, 1.0)),
            Node(id="use_again", initial=(0.0, 0.0)),
        ),
        arcs=tuple(
            Arc(id=id_, donor=donor, recipient=recipient, law=Law.EXOGENOUS, flow=0.1)
            for id_, (donor, recipient) in flows.items()
        ),
        services=(
            Service(id="served", provider="use", quantity="stock", low=Series(times=(0.0, 1.0), values=(1.0, 2.0))),
        ),
        episode=Episode(horizon=2),
    )


def columns(table: Table) -> list[list[str]]:
    """Return the cells of a table, column by column."""
    return [[str(cell) for cell in column.cells] for column in table.columns]


def test_the_sign_of_a_flow_in_circularity_is_shown() -> None:
    """What leaves a reservoir counts against λ, what goes back for it, all else not at all."""
    assert columns(terminal.arcs_table(loop(), np.array([3.0, 2.0, 1.0])))[2:4] == [["3", "2", "1"], ["−", "", "+"]]


def test_who_sees_a_disturbance_when_is_shown() -> None:
    """Late, ahead, or as it is."""
    common: dict[str, Any] = {"kind": "markov", "ends": (0.0, 1.0), "unit": "1", "observed": "now"}
    parts = [
        SimpleNamespace(delayed=delayed, forecast=forecast, observed_by=(), **common)
        for delayed, forecast in ((2, 0), (0, 3), (0, 0))
    ]
    processes = SimpleNamespace(names=("a", "b", "c"), disturbances=parts)
    network: Any = SimpleNamespace(processes=processes, disturbed={"arcs.x.rate": SimpleNamespace(by="b")})
    table = columns(terminal.disturbances_table(network))
    assert table[3:] == [["2 late", "3 ahead", "now"], ["", "arcs.x.rate", ""]]


def test_savings_are_relative_to_business_as_usual() -> None:
    """A quarter of four is saved, as text and in the workbook; what goes back to the reservoir is none of it."""
    plan, usual = (SimpleNamespace(flow=np.array([[flow + 0.5, 0.0, 0.5]] * 2)) for flow in (1.5, 2.0))
    schedule: Any = SimpleNamespace(network=loop(), rollout=plan, usual=usual)
    name, *figures = columns(decisions.savings_table(schedule))
    assert figures == [["4"], ["3"], ["1 (25%)"]]
    assert list(decisions._saving_rows(schedule))[1] == [name[0], 4.0, 3.0, 1.0]


def test_differences_are_in_percent_of_the_first() -> None:
    """And there are none of what differs by round-off, and no share of what is 0 at first."""
    arrays = {"values": [-2.0, -1.5, -2.0], "differences": [0.0, 0.5, 1e-12], "relative_differences": [0.0, 0.25, 0.0]}
    quantity: Any = SimpleNamespace(**{name: np.array(values) for name, values in arrays.items()}, round_off=1e-9)
    assert list(differences._cells(quantity)) == ["-2", "-1.5\n+0.5 (+25%)", "-2"]
    quantity.relative_differences[1] = np.nan
    assert list(differences._cells(quantity))[1] == "-1.5\n+0.5"


def test_bands_that_are_shown_are_the_widest(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """After λ and services, relative to their medians."""
    rng, shown = np.random.default_rng(), list[str]()

    def quantities(network: Network, *kinds: str) -> Iterator[Any]:
        widths = {"mean circularity": 0.1, "level of served": 0.1, "flow": 0.1, "stock": 5.0, "set": 0.0}
        for name, width in widths.items():
            values = 100.0 + width * rng.uniform(size=(9, 2))
            yield SimpleNamespace(name=name, kind=name, unit="t", values=lambda run, values=values: values)

    def noted(path: Path, network: Network, panels: list[Any], **options: Any) -> Path:
        shown.extend(panel.title for panel in panels)
        return path

    monkeypatch.setattr(samples, "episode_quantities", quantities)
    monkeypatch.setattr(samples, "save_panels", noted)
    drawn: Any = SimpleNamespace(network=loop(), rollout=None)
    samples.save_bands(tmp_path / "bands.png", drawn, title="")
    assert [title.lower() for title in shown] == ["mean circularity", "level of served", "stock", "flow"]


def test_who_books_most_comes_first() -> None:
    """Whatever its sign."""
    ledger = SimpleNamespace(account=np.zeros(3, int), compartments=["a", "b", "c"], discount=np.ones((1, 1)))
    rollout = SimpleNamespace(entries=np.array([[1.0, -5.0, 2.0]]))
    simulation: Any = SimpleNamespace(env=SimpleNamespace(ledger=ledger), rollout=rollout)
    assert [id_ for id_, _, _ in account_tables._by_compartment(simulation, 0)] == ["b", "c", "a"]


def test_a_service_is_missed_beyond_its_tolerance() -> None:
    """Not before."""
    task = load_task("paper_city-v0")
    for lack, text in ((0.5, "10.0%"), (2.0, "10.0% (missed)")):
        service = task.min_service - lack * task.tolerance
        row = ResultRow(task=task.name, algorithm="mpc", episodes=4, gap=0.1, service=service)
        assert benchmark_tables._gap([row]) == text


def test_budgets_that_margins_do_not_keep_are_told() -> None:
    """Those that are exceeded by more than is close."""
    for factor in (0.5, 10.0):
        calibration = SimpleNamespace(margin=1.05, budget_margin=1.0, overrun=factor * CLOSE)
        entry = SimpleNamespace(calibration=calibration, milliseconds=0.1, uncertain_bound=None, bound=None)
        row = SimpleNamespace(name="mpc", seeds=(), has_few_seeds=False, entries=[entry])
        baseline = SimpleNamespace(reason="")
        comparison: Any = SimpleNamespace(ties=None, rows=[row], entries=[entry], baseline=baseline, misses=lambda: {})
        comparison.network = loop()
        notes = tradeoffs.comparison_notes(comparison)
        assert notes[0] == "margins, set on other draws: mpc 1.05"
        assert any("exceeds a budget by 2.0% there" in note for note in notes) == (factor > 1)


def test_episodes_have_the_seeds_of_their_starts() -> None:
    """Counted from the first, not from 0."""
    entry = SimpleNamespace(name="mpc", seed=None, run=None, circularity=np.array([-1.0, np.nan]))
    comparison: Any = SimpleNamespace(entries=[entry], figures=("circularity",), episodes=2, first_seed=100)
    assert list(tradeoffs._episode_rows(comparison)) == [
        ["mpc", None, None, 0, -1.0, 100],
        ["mpc", None, None, 1, None, 101],
    ]


def test_what_a_page_says_of_a_service() -> None:
    """The least and the most that is demanded of it over time."""
    network = loop()
    told = page_data._service(network, network.services[0], ())
    assert (told["low"], told["high"]) == (1, 2)
    assert [arc["sign"] for arc in page_data._network(network, [_page_episode(network)])["arcs"]] == [-1, 0, 1]


def _page_episode(network: Network) -> Any:
    return SimpleNamespace(rollout=SimpleNamespace(flow=np.ones((2, 3))), agents=(), network=network)


def test_ages_at_the_start_and_at_the_end_are_told_apart(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Bars are what is there at the end, the outline is what was there before."""
    drawn: list[Figure] = []

    def noted(figure: Figure, path: Path) -> Path:
        drawn.append(figure)
        return path

    monkeypatch.setattr(trajectory, "save", noted)
    mass = np.array([[5.0, 1.0], [3.0, 3.0], [2.0, 4.0]])
    trajectory.save_pyramids(tmp_path / "ages.png", loop(), [Pyramid("use", 1.0, mass)], title="")
    (panel,) = drawn[0].axes
    widths = {bar.get_label(): [part.get_width() for part in bar] for bar in panel.containers}
    assert widths == {"end": [2.0, 4.0]}
    outlines = {
        patch.get_label(): patch.get_data().values.tolist() for patch in panel.patches if hasattr(patch, "get_data")
    }
    assert outlines == {"start": [5.0, 1.0]}


def test_weights_that_nothing_tells_are_dashes() -> None:
    """Shares of all in percent, and what a unit is worth."""
    terms = [SimpleNamespace(name=name, kind="kind", unit="t", about="") for name in ("λ̄", "idle")]
    ranges = {"spread": [1.0, 0.0], "low": [0.2, 0.0], "high": [0.4, 0.0], "centre": [0.3, 0.0]}
    weights: Any = SimpleNamespace(
        terms=terms,
        within=0.01,
        weights=lambda centre: np.array([1.5, np.nan]),
        **{name: np.array(values) for name, values in ranges.items()},
    )
    rows = [*zip(*columns(objective_weights.weights_table(weights)), strict=True)]
    assert rows == [("λ̄", "20 %", "40 %", "30 %", "1.5", "t"), ("idle", "–", "–", "–", "–", "t")]
