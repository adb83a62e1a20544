"""What each lever brings: a table, its CSV file, and a chart that leads from business as usual to all levers."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from cirl_marl.drawing.style import FAINT, INK, NEUTRAL, SERIES, WARNING, WIDTH, draw_steps, number, save, style_axes
from cirl_marl.evaluation.figures import provenance
from cirl_marl.evaluation.levers import Levers
from cirl_marl.records.files import publish_result
from cirl_marl.report.terminal import text_table

CASES = ("alone", "with those above", "without it")


def levers_table(levers: Levers) -> Table:
    """One row a lever: what λ̄ gains by it in three ways, and the lowest service and largest gap of these episodes.

    Beside that stands what it alone adds to each account.
    """
    rows = []
    for place, row in enumerate(levers.rows):
        trials = (row.alone, row.added, row.without)
        changes = (number(change) for change in levers.changes(place))
        service, largest = min(trial.service for trial in trials), max(trial.gap or 0.0 for trial in trials)
        gap = "–" if row.alone.gap is None else f"{largest:.1%}"
        books = map(number, levers.account_changes(place)[0].tolist())
        rows.append([row.name, *changes, *books, f"{levers.share(place):.0%}", f"{service:.4f}", gap])
    mass = levers.network.mass_unit
    headings = ["lever", *(f"{case} ({mass})" for case in CASES)]
    headings += [f"{account.id}, alone ({account.unit})" for account in levers.network.accounts]
    headings += ["all so far", "lowest service", "largest gap"]
    title = f"λ̄ as usual {number(levers.usual.circularity)} {mass}, with all levers"
    title += f" {number(levers.together.circularity)} {mass}, at most {number(levers.plan.objective)} {mass}"
    return text_table(title, headings, rows, text=["lever"])


def write_levers(levers: Levers, folder: Path, **options: Any) -> list[Path]:
    """Write table, provenance and chart, all of them or none, and return their paths."""
    mass = levers.network.mass_unit
    figures = [f"circularity ({mass})", f"change ({mass})", "lowest service", f"bound ({mass})", "gap to bound"]
    figures += [f"change of {account.id} ({account.unit})" for account in levers.network.accounts]
    header = ["lever", "agents", *(f"{case}: {figure}" for case in CASES for figure in figures), "all so far"]
    rows = list(_rows(levers))
    about: dict[str, Any] = {"provenance": provenance(levers.network, **options), "unit": mass}
    about |= {"as usual": levers.usual.circularity, "all levers": levers.together.circularity}
    about["bound"] = levers.plan.objective
    about |= {"columns": header, "rows": rows}
    picture = partial(save_levers, levers=levers)
    return publish_result(folder, {"levers.csv": (header, rows)}, {"levers.png": picture}, {"levers.json": about})


def _rows(levers: Levers) -> Iterator[list[object]]:
    for place, row in enumerate(levers.rows):
        trials, books = (row.alone, row.added, row.without), levers.account_changes(place).tolist()
        parts = zip(trials, levers.changes(place), books, strict=True)
        cells: list[object] = []
        for trial, change, amounts in parts:
            cells += [trial.circularity, change, trial.service, trial.bound, trial.gap, *amounts]
        yield [row.name, " ".join(row.agents), *cells, levers.share(place)]


def save_levers(path: str | Path, levers: Levers, *, title: str = "") -> Path:
    """Save a chart as a PNG and return its path.

    Left, each lever takes λ̄ on from where those above it left it; right, what it brings alone and what is lost without
    it.
    """
    network, count = levers.network, len(levers.rows)
    changes = np.array([levers.changes(place) for place in range(count)])
    added, names = changes[:, 1], [row.name for row in levers.rows]
    usual, whole = levers.usual.circularity, levers.together.circularity
    ends, places = usual + np.cumsum(added), np.arange(1, count + 1)
    figure = Figure(figsize=(WIDTH, 1.7 + 0.34 * (count + 2)), layout="constrained")
    figure.suptitle(title or f"{network.title or network.name}: what each lever brings", fontsize=12, fontweight="bold")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(2.1, 1))
    span = max(abs(levers.plan.objective - usual), abs(whole - usual)) or 1.0
    notes = []
    for end, change in zip(ends, added, strict=True):
        part = f"  {(end - usual) / (whole - usual):.0%}" if whole != usual else ""
        notes.append(f"{'+' if change > 0 else ''}{number(change)}{part}")
    colours = [SERIES[0] if change >= 0 else WARNING for change in added]
    draw_steps(left, added, colours, notes, start=usual)
    for tick, value in ((0, usual), (count + 1, whole)):
        left.plot(value, tick, "D", color=INK, markersize=6)
        left.text(value + 0.03 * span, tick, number(value), va="center", fontsize=8, color=INK)
    left.axvline(levers.plan.objective, color=FAINT, linestyle="--", linewidth=1, label="no plan exceeds this")
    left.set_yticks([0, *places, count + 1], ["as usual", *names, "all levers"])
    left.invert_yaxis()
    left.set_xlim(min(usual, *ends) - 0.04 * span, max(levers.plan.objective, *ends, usual) + 0.22 * span)
    right.hlines(places, changes[:, [0, 2]].min(axis=1), changes[:, [0, 2]].max(axis=1), color=NEUTRAL, linewidth=1.5)
    right.plot(changes[:, 0], places, "o", color=SERIES[2], markersize=6, label="it alone")
    hollow = {"markerfacecolor": "white", "color": SERIES[1]}
    right.plot(changes[:, 2], places, "o", markersize=6, label="lost without it", **hollow)
    right.axvline(0.0, color=NEUTRAL, linewidth=1)
    mass = network.mass_unit
    style_axes(left, title="added to those above, and the share of all so far", size=8.5)
    style_axes(right, title="by itself", size=8.5)
    for axes, label in ((left, f"λ̄ / {mass}"), (right, f"change of λ̄ / {mass}")):
        axes.set_xlabel(label, fontsize=9)
        axes.grid(False, axis="y")
        axes.tick_params(axis="y", length=0, labelcolor=INK)
        axes.locator_params(axis="x", nbins=5)
        axes.legend(loc="lower left" if axes is left else "lower right", frameon=False, fontsize=8)
    return save(figure, path)
