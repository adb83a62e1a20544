"""Results of the benchmark: gaps by task, aggregates over tasks and seeds, transfer, and performance profiles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from cirl_marl.drawing.style import DASHES, SERIES, WIDTH, save, style_axes
from cirl_marl.errors import CirlError
from cirl_marl.evaluation.aggregates import STATISTICS, aggregate, performance_profile, probability_of_improvement
from cirl_marl.evaluation.statistics import Aggregate, interquartile_mean
from cirl_marl.network import Floats
from cirl_marl.report.terminal import text_table
from cirl_marl.suite.result_rows import ResultRow
from cirl_marl.suite.tasks import CONTROLLERS, algorithms, load_task, tasks

THRESHOLDS = np.linspace(0.0, 1.0, 101)
MISS = "(missed)"
"""What stands behind a gap at which the service is missed."""
Cells = tuple[list[str], list[list[str]]]
"""Headings and rows of a table."""


def who_acts(rows: Sequence[ResultRow]) -> list[str]:
    """Return controllers and learners that have rows: those of the suite in its order, then others."""
    present = dict.fromkeys(row.algorithm for row in rows)
    order = [name for name in (*CONTROLLERS, *algorithms()) if name in present]
    return [*order, *(name for name in present if name not in order)]


def scores_by_algorithm(rows: Sequence[ResultRow]) -> dict[str, Floats]:
    """Return scores, shape (tasks, seeds), of those who have rows on every task; of the first seeds, as many on each.

    Who has rows on some tasks alone is left out: figures over other tasks would not compare.
    """
    scores: dict[str, Floats] = {}
    for name in who_acts(rows):
        own_rows = sorted((row for row in rows if (row.algorithm, row.variant) == (name, 0)), key=lambda r: r.seed or 0)
        by_task = [[row for row in own_rows if row.task == task] for task in tasks()]
        if count := min(map(len, by_task)):
            scores[name] = np.array([[row.score for row in part[:count]] for part in by_task])
    return scores


def gap_cells(rows: Sequence[ResultRow]) -> Cells:
    """Return the gap of each algorithm on each task: of several seeds the interquartile mean, and how many."""
    names, body = who_acts(rows), []
    for task in tasks():
        cells = [[row for row in rows if (row.task, row.algorithm, row.variant) == (task, name, 0)] for name in names]
        body.append([f"`{task}`", *map(_gap, cells)])
    return ["task", *(name.replace("_", " ") for name in names)], body


def _gap(rows: Sequence[ResultRow]) -> str:
    if not rows:
        return ""
    task = load_task(rows[0].task)
    misses = sum(row.service < task.min_service - task.tolerance for row in rows)
    text = f"{interquartile_mean([row.gap for row in rows]):.1%}"
    share = f" ({misses} of {len(rows)} missed)" if misses and len(rows) > 1 else f" {MISS}" if misses else ""
    return text + share


def aggregate_cells(rows: Sequence[ResultRow]) -> Cells:
    """Return the figures of ``aggregates.STATISTICS`` of the scores of each algorithm, with their intervals."""
    body = []
    for name, scores in scores_by_algorithm(rows).items():
        figures = aggregate(scores).values()
        body.append([name.replace("_", " "), f"{scores.shape[1]}", *map(_figure, figures)])
    return ["who acts", "seeds", *STATISTICS], body


def improvement_cells(rows: Sequence[ResultRow]) -> Cells:
    """Return the probability that the algorithm of a row scores higher than that of a column, with its interval."""
    scores = scores_by_algorithm(rows)
    names = [name for name in scores if name != "neutral"]
    body = []
    for name in names:
        by_rival = {rival: probability_of_improvement(scores[name], scores[rival]) for rival in names if rival != name}
        body.append([name.replace("_", " "), *(_figure(by_rival[rival]) if rival != name else "" for rival in names)])
    return ["better than", *(name.replace("_", " ") for name in names)], body


def _figure(figure: Aggregate) -> str:
    text = f"{figure.value:.3f}"
    return text if figure.high - figure.low < 1e-9 else f"{text} [{figure.low:.2f}, {figure.high:.2f}]"


def held_out_cells(rows: Sequence[ResultRow]) -> Cells:
    """Return the mean score of each algorithm on its tasks, and of the same policies on their held-out variants."""
    body = []
    for name in who_acts(rows):
        held_out = [row for row in rows if row.algorithm == name and row.variant]
        ids = {row.id for row in held_out}
        base_rows = [row for row in rows if row.id in ids and not row.variant]
        if held_out and base_rows:
            service_share = np.mean([load_task(row.task).score(0.0, row.service) for row in held_out])
            means = [np.mean([row.score for row in part]) for part in (base_rows, held_out)]
            figures = [f"{mean:.3f}" for mean in means]
            body.append([name.replace("_", " "), f"{len(base_rows)}", *figures, f"{service_share:.0%}"])
    return ["who acts", "policies", "score", "score on held-out variants", "of these served"], body


TABLES: dict[str, Callable[[Sequence[ResultRow]], Cells]] = {
    "gap to the bound": gap_cells,
    "scores over all tasks": aggregate_cells,
    "probability of improvement": improvement_cells,
    "transfer": held_out_cells,
}


def benchmark_tables(rows: Sequence[ResultRow]) -> list[Table]:
    """Return the tables of TABLES that have rows."""
    tables = []
    for title, cells_of in TABLES.items():
        headings, body = cells_of(rows)
        if body:
            plain = [[cell.replace("`", "") for cell in cells] for cells in body]
            tables.append(text_table(title, headings, plain, text=headings[:1]))
    return tables


def save_profiles(path: str | Path, rows: Sequence[ResultRow]) -> Path:
    """Save performance profiles as a PNG and return its path: the share of runs with at least each score.

    Raises:
        CirlError: if nobody but neutral control has rows on every task.
    """
    scores = {name: table for name, table in scores_by_algorithm(rows).items() if name != "neutral"}
    if not scores:
        raise CirlError("performance profiles: nobody has rows on every task, neutral control apart")
    figure = Figure(figsize=(WIDTH, 0.5 * WIDTH), layout="constrained")
    axes = figure.subplots()
    for place, (name, table) in enumerate(scores.items()):
        colour, dash = SERIES[place % len(SERIES)], DASHES[place // len(SERIES) % len(DASHES)]
        share, low, high = performance_profile(table, THRESHOLDS)
        axes.step(THRESHOLDS, share, where="post", color=colour, linestyle=dash, label=name.replace("_", " "))
        axes.fill_between(THRESHOLDS, low, high, step="post", color=colour, alpha=0.12, linewidth=0)
    style_axes(axes, ylabel="share of runs with a score of at least τ")
    axes.set(xlabel="score τ", xlim=(0, 1), ylim=(0, 1.02))
    axes.legend(frameon=False, fontsize=9, loc="lower left")
    return save(figure, path)
