"""Comparisons of policies and Pareto fronts of service and circularity: tables, pictures, and their files."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from cirl_marl.evaluation.calibration import CLOSE, Calibration
from cirl_marl.evaluation.comparison import Comparison, Row
from cirl_marl.evaluation.episode_count import EPISODES_DISTURBED, MOST_EPISODES
from cirl_marl.evaluation.figures import provenance
from cirl_marl.evaluation.pareto import ParetoFront
from cirl_marl.evaluation.statistics import ENOUGH_SEEDS, Aggregate, finite_or_none, interquartile_mean
from cirl_marl.network import Network
from cirl_marl.records.files import publish_result
from cirl_marl.report.curves import PointSeries, save_fronts
from cirl_marl.report.terminal import text_table

FORMS = {
    "circularity": "{:.4g}",
    "gain": "{:+.1%}",
    "service": "{:.4f}",
    "bound": "{:.4g}",
    "gap": "{:.1%}",
    "expected_gap": "{:.2%}",
    "foresight_gap": "{:.2%}",
}
"""How the figures of a comparison are written on screen."""


def comparison_table(comparison: Comparison) -> Table:
    """One row a recipe or controller: λ̄, gain, service, bound and gap with 95 % confidence intervals."""
    rows = []
    for row in comparison.rows:
        seeds = f"{len(row.seeds)} (few)" if row.has_few_seeds else str(len(row.seeds) or "")
        cells = [_interval(row.figure(name), FORMS[name]) for name in comparison.figures]
        rows.append([row.name, seeds, *cells])
    headings = ["policy", "seeds", f"λ̄ ({comparison.network.mass_unit})", *_headers(comparison)[1:]]
    title = f"{comparison.episodes} fresh episodes, the same for all; 95 % confidence intervals in brackets"
    return text_table(title, headings, rows, text=["policy"])


def worst_table(comparison: Comparison) -> Table:
    """One row a recipe or controller: what is expected of each service, and the 5 % worst episodes of each figure."""
    rows = [[row.name, *cells] for row, cells in zip(comparison.rows, _worst(comparison), strict=True)]
    title = "expected, and mean of the 5 % worst episodes of each figure by itself; 95 % intervals in brackets"
    return text_table(title, ["policy", *_worst_headers(comparison)], rows, text=["policy"])


def worst_notes(comparison: Comparison) -> list[str]:
    """Return the rows of ``worst_table`` as sentences, without intervals."""
    notes = []
    for row, cells in zip(comparison.rows, _worst(comparison), strict=True):
        figures = zip(_worst_headers(comparison), cells, strict=True)
        notes.append(f"{row.name}: {', '.join(f'{head} {cell.splitlines()[0]}' for head, cell in figures)}.")
    return notes


def _worst_headers(comparison: Comparison) -> list[str]:
    services = [service.id for service in comparison.network.services]
    worst = [f"worst λ̄ ({comparison.network.mass_unit})", *(f"worst level of {id_}" for id_ in services)]
    return [*(f"level of {id_}" for id_ in services), *worst]


def _worst(comparison: Comparison) -> list[list[str]]:
    """Return the cells of each row, in the order of ``_worst_headers``."""
    levels = ["{:.4f}"] * len(comparison.network.services)
    forms = [*levels, FORMS["circularity"], *levels]
    return [[*map(_interval, [*row.levels(), *row.worst()], forms)] for row in comparison.rows]


def comparison_notes(comparison: Comparison) -> list[str]:
    """Return what the reader of a comparison's table has to know."""
    notes, baseline = [], comparison.baseline
    if comparison.ties is not None:
        count = f"{comparison.episodes}, doubled from {EPISODES_DISTURBED} to at most {MOST_EPISODES:,}"
        reason = "the interval of a difference between two rows is wider than the difference"
        notes.append(f"episodes: {count} while {reason}")
    if comparison.ties:
        notes.append(f"not told apart: {', '.join(comparison.ties)}")
    if any(row.seeds for row in comparison.rows):
        trained = "interquartile mean over training seeds, bootstrap over seeds"
        notes.append(f"trained: {trained}; controllers: mean over episodes, Student's t")
    if any(row.has_few_seeds for row in comparison.rows):
        notes.append(f"few: fewer than {ENOUGH_SEEDS} training seeds; the interval says little, one seed has none")
    by_name = {row.name: row.entries[0].calibration for row in comparison.rows}
    calibrations = {name: calibration for name, calibration in by_name.items() if calibration is not None}
    if calibrations:
        margins = [
            f"{name} {_margins_text(calibration, comparison.network)}" for name, calibration in calibrations.items()
        ]
        notes.append(f"margins, set on other draws: {', '.join(margins)}")
    for name, calibration in calibrations.items():
        if calibration.overrun > CLOSE:
            notes.append(f"{name}: what it is expected to book exceeds a budget by {calibration.overrun:.1%} there")
    for name, excess in comparison.misses().items():
        notes.append(f"{name}: its expected service misses what is demanded by {excess:+.4f}")
    times = {row.name: _milliseconds(row) for row in comparison.rows}
    if slow := [f"{name} {time:.2g} ms" for name, time in times.items() if time >= 1]:
        notes.append(f"processor time of a decision: {', '.join(slow)}; of others less than 1 ms")
    if (expected := comparison.entries[0].uncertain_bound) is not None:
        notes += [str(expected), "gaps: (bound − λ̄ − Σ μ·(service − demand)) of each draw over one scale"]
        gaps = {row.name: figure.value for row in comparison.rows if (figure := row.figure("foresight_gap"))}
        best = min(gaps, key=gaps.__getitem__)
        if gaps[best] > 0:
            share = f"{round(100 * expected.closure(gaps[best]))} % of the gap of {best}"
            notes.append(f"prices on what is new, in place of perfect information, close {share}")
    if comparison.entries[0].bound is not None:
        foresight = "" if baseline.envelope is not None else ", whatever anybody knew of what was drawn,"
        episode = f"episode from the same start with at least the same level of each service{foresight}"
        notes.append(f"bound: no {episode} has a higher λ̄")
    elif baseline.reason:
        notes.append(f"gap to bound: {baseline.reason}")
        if any(row.name == "optimum" for row in comparison.rows):
            notes.append("optimum: the best plan found by search, no certificate")
    return notes


def _interval(aggregate: Aggregate | None, form: str) -> str:
    if aggregate is None or not math.isfinite(aggregate.value):
        return "–"
    value, low, high = (form.format(figure) for figure in (aggregate.value, aggregate.low, aggregate.high))
    return f"{value}\n[{low}, {high}]" if math.isfinite(aggregate.low) else value


def save_comparison(path: str | Path, comparison: Comparison, *, title: str = "") -> Path:
    """Save where each policy and controller of a comparison is, training seed by training seed."""
    series = []
    for row in comparison.rows:
        service = np.array([entry.rollout.least_service.mean() for entry in row.entries])
        series.append(PointSeries(row.name, service, np.array([entry.circularity.mean() for entry in row.entries])))
    title = title or f"{comparison.network.title or comparison.network.name}: {comparison.episodes} episodes"
    return save_fronts(path, comparison.network, series, comparison.baseline.front, title=title)


def write_comparison(comparison: Comparison, folder: Path, **options: Any) -> list[Path]:
    """Write the files of a comparison, all of them or none, and return them; ``options`` are for the provenance.

    They are ``episodes.csv`` with a row for each episode of each policy and controller, ``summary.csv`` and
    ``summary.json`` with the figures of the table, and ``comparison.png``. Those of an earlier comparison are replaced.
    """
    units = _headers(comparison)
    episodes = ["name", "training seed", "run", "episode", *units, "start seed"]
    summary = ["name", "training seeds", *(f"{name}{end}" for name in units for end in ("", ", low", ", high"))]
    tables = {
        "episodes.csv": (episodes, _episode_rows(comparison)),
        "summary.csv": (summary, _summary_rows(comparison)),
    }
    picture, record = partial(save_comparison, comparison=comparison), summary_of(comparison, **options)
    return publish_result(folder, tables, {"comparison.png": picture}, {"summary.json": record})


def summary_of(comparison: Comparison, **options: Any) -> dict[str, Any]:
    """Return the figures of a comparison with their provenance, ready for JSON."""
    runs = [entry.run for entry in comparison.entries if entry.run is not None]
    rows = []
    for row in comparison.rows:
        figures = {name: row.figure(name) for name in comparison.figures}
        plain: dict[str, Any] = {k: None if figure is None else figure.as_dict() for k, figure in figures.items()}
        ids = [service.id for service in comparison.network.services]
        levels, (worst, *worst_levels) = row.levels(), row.worst()
        plain["worst_circularity"] = worst.as_dict()
        for name, parts in (("service_levels", levels), ("worst_service_levels", worst_levels)):
            plain[name] = {id_: part.as_dict() for id_, part in zip(ids, parts, strict=True)}
        totals = zip(comparison.network.accounts, row.accounts(), strict=True)
        plain["accounts"] = {account.id: total.as_dict() for account, total in totals}
        calibration = row.entries[0].calibration
        plain["milliseconds"] = _milliseconds(row)
        plain["calibration"] = None if calibration is None else calibration.as_dict()
        rows.append({"name": row.name, "seeds": list(row.seeds), **plain})
    expected = comparison.entries[0].uncertain_bound
    return {
        "provenance": provenance(comparison.network, runs, **options),
        "unit": comparison.network.mass_unit,
        "agents": list(comparison.agents),
        "episodes": comparison.episodes,
        "ties": None if comparison.ties is None else list(comparison.ties),
        "first_seed": comparison.first_seed,
        "no_bound": comparison.baseline.reason or None,
        "uncertain_bound": None if expected is None else expected.as_dict(),
        "front": [{"service": level, "bound": bound} for level, bound in comparison.baseline.front.tolist()],
        "rows": rows,
    }


def _headers(comparison: Comparison) -> list[str]:
    """Return the figures as headers with their units."""
    mass = comparison.network.mass_unit
    words = {
        "circularity": f"circularity ({mass})",
        "gain": "gain over neutral",
        "service": "service level",
        "bound": f"bound ({mass})",
        "gap": "gap to bound",
        "expected_gap": "gap to bound without foresight",
        "foresight_gap": "gap to perfect information",
    }
    return [words[name] for name in comparison.figures]


def _margins_text(calibration: Calibration, network: Network) -> str:
    """Return the margins, and that on budgets where they are dearer."""
    budgets, margin = calibration.budget_margin, calibration.margin
    if isinstance(margin, tuple):
        parts = zip(network.services, margin, strict=True)
        text = ", ".join(f"{factor:.4g} of '{service.id}'" for service, factor in parts)
    else:
        text = f"{margin:.4g}"
    return text + (f" (of budgets {budgets:.4g})" if budgets != 1.0 else "")


def _milliseconds(row: Row) -> float:
    """Return the processor time of a decision, ms."""
    return float(np.mean([entry.milliseconds for entry in row.entries]))


def _episode_rows(comparison: Comparison) -> Iterator[list[object]]:
    for entry in comparison.entries:
        columns = [getattr(entry, name) for name in comparison.figures]
        run = None if entry.run is None else entry.run.path
        for episode in range(comparison.episodes):
            figures = [None if column is None else finite_or_none(column[episode]) for column in columns]
            yield [entry.name, entry.seed, run, episode, *figures, comparison.first_seed + episode]


def _summary_rows(comparison: Comparison) -> Iterator[list[object]]:
    for row in comparison.rows:
        figures = [row.figure(name) for name in comparison.figures]
        cells = [[None] * 3 if figure is None else figure.as_dict().values() for figure in figures]
        yield [row.name, len(row.seeds) or None, *(cell for interval in cells for cell in interval)]


def write_front(front: ParetoFront, folder: Path, **options: Any) -> list[Path]:
    """Write table, provenance and picture, all of them or none, and return their paths."""
    mass = front.network.mass_unit
    header = ["kind", "least service level", f"circularity ({mass})", "circularity weight", "training seed"]
    points = [[point.kind, point.service, point.circularity, point.weight, point.seed] for point in front.points]
    about: dict[str, Any] = {"provenance": provenance(front.network, front.runs, **options)}
    about["no_bound"] = front.reason or None
    about |= {"columns": header, "points": points}
    picture = partial(save_pareto, front=front)
    return publish_result(folder, {"pareto.csv": (header, points)}, {"pareto.png": picture}, {"pareto.json": about})


def save_pareto(path: str | Path, front: ParetoFront, *, title: str = "") -> Path:
    """Save service against circularity as a PNG and return its path; of several seeds the interquartile mean."""
    network, title = front.network, title or f"{front.network.title or front.network.name}: service against circularity"
    points = front.of("trained")
    weights = sorted({point.weight for point in points if point.weight is not None})
    groups = {
        f"trained: {front.recipe.name if front.recipe else ''}": [
            [point for point in points if point.weight == weight] for weight in weights
        ],
        "plan in the simulator": [[point] for point in front.of("plan")],
        "neutral": [[point] for point in front.of("neutral")],
    }
    series = []
    for name, parts in groups.items():
        if parts:
            service = np.array([interquartile_mean([point.service for point in part]) for part in parts])
            mean = np.array([interquartile_mean([point.circularity for point in part]) for part in parts])
            series.append(PointSeries(name, service, mean, is_line=len(parts) > 1))
    return save_fronts(path, network, series, front.front, title=title)
