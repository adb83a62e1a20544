"""A sweep between circularity and service on disk: table, provenance and picture."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cirl_marl.evaluation.figures import provenance
from cirl_marl.evaluation.pareto import ParetoFront
from cirl_marl.evaluation.statistics import interquartile_mean
from cirl_marl.records.files import published, write_json, write_table
from cirl_marl.report.curves import PointSeries, save_fronts

FILES = ("pareto.csv", "pareto.json", "pareto.png")


def write_sweep(sweep: ParetoFront, folder: Path, **options: Any) -> list[Path]:
    """Write table, provenance and picture, all of them or none, and return their paths."""
    mass = sweep.network.mass_unit
    header = ["kind", "least service level", f"circularity ({mass})", "circularity weight", "training seed"]
    plain = [[each.kind, each.service, each.circularity, each.weight, each.seed] for each in sweep.points]
    about = {"provenance": provenance(sweep.network, sweep.runs, **options), "no_bound": sweep.reason or None}
    with published(folder) as partial:
        write_table(partial / FILES[0], header, plain)
        write_json(partial / FILES[1], about | {"columns": header, "points": plain})
        title = f"{sweep.network.title or sweep.network.name}: service against circularity"
        save_fronts(partial / FILES[2], sweep.network, list(_series(sweep)), sweep.front, title=title)
    return [folder / name for name in FILES]


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
