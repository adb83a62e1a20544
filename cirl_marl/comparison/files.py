"""A comparison on disk: every episode, the table, what it all depends on, and a picture."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cirl_marl.comparison.compare import FIGURES, Comparison, Entry
from cirl_marl.learners.run import write_json
from cirl_marl.results import provenance, published, write_table
from cirl_marl.statistics import defined

FILES = ("episodes.csv", "summary.csv", "summary.json", "comparison.png")


def write_comparison(comparison: Comparison, folder: Path, **options: Any) -> list[Path]:
    """Write the files of a comparison, all of them or none.

    Args:
        comparison: what to write.
        folder: made if missing; files of an earlier comparison in it are replaced.
        **options: what was asked for, for the provenance.

    Returns:
        The files: ``episodes.csv`` with a row for each episode of each policy and controller, ``summary.csv`` and
        ``summary.json`` with the figures of the table, and ``comparison.png``.
    """
    from cirl_marl.report.comparison import save_comparison

    with published(folder) as partial:
        write_table(partial / FILES[0], [*_columns(comparison), "start seed"], _episodes(comparison))
        write_table(partial / FILES[1], _summary_columns(comparison), _summary(comparison))
        write_json(partial / FILES[2], summary_of(comparison, **options))
        save_comparison(partial / FILES[3], comparison)
    return [folder / name for name in FILES]


def summary_of(comparison: Comparison, **options: Any) -> dict[str, Any]:
    """Return the figures of a comparison with their provenance, ready for JSON."""
    runs = [entry.run for entry in comparison.entries if entry.run is not None]
    return {
        "provenance": provenance(comparison.network, runs, **options),
        "unit": comparison.network.mass_unit,
        "agents": list(comparison.agents),
        "episodes": comparison.episodes,
        "first_seed": comparison.first_seed,
        "no_bound": comparison.yardstick.reason or None,
        "front": [{"service": level, "bound": bound} for level, bound in comparison.yardstick.front.tolist()],
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


def _columns(comparison: Comparison) -> list[str]:
    return ["name", "training seed", "run", "episode", *_units(comparison)]


def _episodes(comparison: Comparison) -> Iterator[list[object]]:
    for entry in comparison.entries:
        for episode in range(comparison.episodes):
            figures = [_value(entry, which, episode) for which in FIGURES]
            run = None if entry.run is None else str(entry.run.path)
            yield [entry.name, entry.seed, run, episode, *figures, comparison.first_seed + episode]


def _value(entry: Entry, which: str, episode: int) -> float | None:
    values = getattr(entry, which)
    return None if values is None else defined(values[episode])


def _summary_columns(comparison: Comparison) -> list[str]:
    ends = [column for name in _units(comparison) for column in (name, f"{name}, low", f"{name}, high")]
    return ["name", "training seeds", *ends]


def _summary(comparison: Comparison) -> Iterator[list[object]]:
    for row in comparison.rows:
        cells: list[object] = [row.name, len(row.seeds) or None]
        for which in FIGURES:
            found = row.figure(which)
            cells += [None] * 3 if found is None else list(found.as_dict().values())
        yield cells
