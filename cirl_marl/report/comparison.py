"""Table and picture of a comparison."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from rich.table import Table

from cirl_marl.comparison.compare import FIGURES, Comparison
from cirl_marl.report.fronts import Series, save_fronts
from cirl_marl.statistics import ENOUGH_SEEDS, Aggregate


def comparison_table(comparison: Comparison) -> Table:
    """One row a recipe or controller: λ̄, gain, service level, bound and gap, with 95 % confidence intervals."""
    unit = comparison.network.mass_unit
    table = Table(
        title=f"{comparison.episodes} fresh episodes, the same for all; 95 % confidence intervals in brackets"
    )
    columns = (
        "policy",
        "seeds",
        f"λ̄ ({unit})",
        "gain over neutral",
        "service level",
        f"bound ({unit})",
        "gap to bound",
    )
    for column in columns:
        table.add_column(column, justify="left" if column == "policy" else "right")
    for row in comparison.rows:
        marked = f"{len(row.seeds)} (few)" if row.few else str(len(row.seeds) or "")
        forms = ("{:.4g}", "{:+.1%}", "{:.4f}", "{:.4g}", "{:.1%}")
        figures = [_aggregate(row.figure(which), form) for which, form in zip(FIGURES, forms, strict=True)]
        table.add_row(row.name, marked, *figures)
    return table


def comparison_notes(comparison: Comparison) -> list[str]:
    """Return what the reader of a comparison's table has to know."""
    notes = []
    if any(row.seeds for row in comparison.rows):
        notes.append(
            "trained: interquartile mean over training seeds, bootstrap over seeds; controllers: mean over episodes, "
            "Student's t"
        )
    if any(row.few for row in comparison.rows):
        notes.append(f"few: fewer than {ENOUGH_SEEDS} training seeds; the interval says little, one seed has none")
    if comparison.yardstick.envelope is not None:
        notes.append("bound: the highest λ̄ of any episode from the same start with at least the same service")
    elif comparison.yardstick.reason:
        notes.append(f"gap to bound: {comparison.yardstick.reason}")
        if any(row.name == "optimum" for row in comparison.rows):
            notes.append("optimum: the best plan found by search, no certificate")
    return notes


def _aggregate(found: Aggregate | None, form: str) -> str:
    if found is None or not math.isfinite(found.value):
        return "–"
    value = form.format(found.value)
    if not math.isfinite(found.low):
        return value
    return f"{value}\n[{form.format(found.low)}, {form.format(found.high)}]"


def save_comparison(path: str | Path, comparison: Comparison) -> Path:
    """Save where each policy and controller of a comparison is, training seed by training seed."""
    series = [
        Series(
            row.name,
            np.array([entry.service.mean() for entry in row.entries]),
            np.array([entry.circularity.mean() for entry in row.entries]),
        )
        for row in comparison.rows
    ]
    title = f"{comparison.network.title or comparison.network.name}: {comparison.episodes} episodes"
    return save_fronts(path, comparison.network, series, comparison.yardstick.front, title=title)
