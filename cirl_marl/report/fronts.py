"""Comparisons of policies and Pareto fronts of service and circularity: tables, pictures, and their files."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from cirl_marl.evaluation.comparison import FIGURES, Comparison
from cirl_marl.evaluation.figures import provenance
from cirl_marl.evaluation.pareto import ParetoFront
from cirl_marl.evaluation.statistics import ENOUGH_SEEDS, Aggregate, defined, interquartile_mean
from cirl_marl.records.files import publish_folder, write_json, write_table
from cirl_marl.report.curves import PointSeries, save_fronts

COMPARISON_FILES = ("episodes.csv", "summary.csv", "summary.json", "comparison.png")
PARETO_FILES = ("pareto.csv", "pareto.json", "pareto.png")


def comparison_table(comparison: Comparison) -> Table:
    """One row a recipe or controller: λ̄, gain, service level, bound and gap, with 95 % confidence intervals."""
    unit = comparison.network.mass_unit
    table = Table(
        title=f"{comparison.episodes} fresh episodes, the same for all; 95 % confidence intervals in brackets"
    )
    for column in ("policy", "seeds", f"λ̄ ({unit})", *_units(comparison)[1:]):
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
    if comparison.entries[0].bound is not None:
        drawn = "" if comparison.baseline.envelope is not None else ", whatever anybody knew of what was drawn,"
        notes.append(
            f"bound: no episode from the same start with at least the same level of each service{drawn} has a higher λ̄"
        )
    elif comparison.baseline.reason:
        notes.append(f"gap to bound: {comparison.baseline.reason}")
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


def save_comparison(path: str | Path, comparison: Comparison, *, title: str = "") -> Path:
    """Save where each policy and controller of a comparison is, training seed by training seed."""
    series = [
        PointSeries(
            row.name,
            np.array([each.rollout.least_service.mean() for each in row.entries]),
            np.array([each.circularity.mean() for each in row.entries]),
        )
        for row in comparison.rows
    ]
    title = title or f"{comparison.network.title or comparison.network.name}: {comparison.episodes} episodes"
    return save_fronts(path, comparison.network, series, comparison.baseline.front, title=title)


def write_comparison(comparison: Comparison, folder: Path, **options: Any) -> list[Path]:
    """Write the files of a comparison, all of them or none, and return them; ``options`` are for the provenance.

    They are ``episodes.csv`` with a row for each episode of each policy and controller, ``summary.csv`` and
    ``summary.json`` with the figures of the table, and ``comparison.png``. Those of an earlier comparison are replaced.
    """
    units = _units(comparison)
    episodes = ["name", "training seed", "run", "episode", *units, "start seed"]
    rows = ["name", "training seeds", *(f"{name}{end}" for name in units for end in ("", ", low", ", high"))]
    with publish_folder(folder) as partial:
        write_table(partial / COMPARISON_FILES[0], episodes, _episodes(comparison))
        write_table(partial / COMPARISON_FILES[1], rows, _summary(comparison))
        write_json(partial / COMPARISON_FILES[2], summary_of(comparison, **options))
        save_comparison(partial / COMPARISON_FILES[3], comparison)
    return [folder / name for name in COMPARISON_FILES]


def summary_of(comparison: Comparison, **options: Any) -> dict[str, Any]:
    """Return the figures of a comparison with their provenance, ready for JSON."""
    runs = [entry.run for entry in comparison.entries if entry.run is not None]
    return {
        "provenance": provenance(comparison.network, runs, **options),
        "unit": comparison.network.mass_unit,
        "agents": list(comparison.agents),
        "episodes": comparison.episodes,
        "first_seed": comparison.first_seed,
        "no_bound": comparison.baseline.reason or None,
        "front": [{"service": level, "bound": bound} for level, bound in comparison.baseline.front.tolist()],
        "rows": [
            {
                "name": row.name,
                "seeds": list(row.seeds),
                **{which: None if (found := row.figure(which)) is None else found.as_dict() for which in FIGURES},
            }
            for row in comparison.rows
        ],
    }


def _units(comparison: Comparison) -> list[str]:
    """Return FIGURES as headers with their units."""
    mass = comparison.network.mass_unit
    return [f"circularity ({mass})", "gain over neutral", "service level", f"bound ({mass})", "gap to bound"]


def _episodes(comparison: Comparison) -> Iterator[list[object]]:
    for entry in comparison.entries:
        for episode in range(comparison.episodes):
            found = [getattr(entry, which) for which in FIGURES]
            figures = [None if each is None else defined(each[episode]) for each in found]
            run = None if entry.run is None else entry.run.path
            yield [entry.name, entry.seed, run, episode, *figures, comparison.first_seed + episode]


def _summary(comparison: Comparison) -> Iterator[list[object]]:
    for row in comparison.rows:
        cells: list[object] = [row.name, len(row.seeds) or None]
        for which in FIGURES:
            found = row.figure(which)
            cells += [None] * 3 if found is None else list(found.as_dict().values())
        yield cells


def write_front(sweep: ParetoFront, folder: Path, **options: Any) -> list[Path]:
    """Write table, provenance and picture, all of them or none, and return their paths."""
    mass = sweep.network.mass_unit
    header = ["kind", "least service level", f"circularity ({mass})", "circularity weight", "training seed"]
    plain = [[each.kind, each.service, each.circularity, each.weight, each.seed] for each in sweep.points]
    about = {"provenance": provenance(sweep.network, sweep.runs, **options), "no_bound": sweep.reason or None}
    with publish_folder(folder) as partial:
        write_table(partial / PARETO_FILES[0], header, plain)
        write_json(partial / PARETO_FILES[1], about | {"columns": header, "points": plain})
        save_pareto(partial / PARETO_FILES[2], sweep)
    return [folder / name for name in PARETO_FILES]


def save_pareto(path: str | Path, front: ParetoFront, *, title: str = "") -> Path:
    """Save service against circularity as a PNG and return its path."""
    title = title or f"{front.network.title or front.network.name}: service against circularity"
    return save_fronts(path, front.network, list(_series(front)), front.front, title=title)


def _series(sweep: ParetoFront) -> Iterator[PointSeries]:
    """Yield what is drawn: of several seeds the interquartile mean at each weight."""
    weights = sorted({each.weight for each in sweep.of("trained") if each.weight is not None})
    alike = {
        f"trained: {sweep.recipe.name if sweep.recipe else ''}": [
            [each for each in sweep.of("trained") if each.weight == weight] for weight in weights
        ],
        "plan in the simulator": [[each] for each in sweep.of("plan")],
        "neutral": [[each] for each in sweep.of("neutral")],
    }
    for name, groups in alike.items():
        if groups:
            service = np.array([interquartile_mean([each.service for each in group]) for group in groups])
            mean = np.array([interquartile_mean([each.circularity for each in group]) for group in groups])
            yield PointSeries(name, service, mean, joined=len(groups) > 1)
