"""Aims as a table and in sentences."""

from __future__ import annotations

import math
from pathlib import Path

from rich.table import Table

from cirl_marl.drawing.style import number
from cirl_marl.reasons.inverse import ObjectiveWeights
from cirl_marl.reasons.sentences import joined_text
from cirl_marl.records.files import write_atomically, write_table


def weights_sentences(found: ObjectiveWeights) -> list[str]:
    """Say how far the plans are from the best, which weights they tell, and which they do not."""
    plans = "This plan" if len(found.plans) == 1 else f"These {len(found.plans)} plans"
    falls = "falls" if len(found.plans) == 1 else "fall"
    short = 100 * found.distance
    said = [
        f"{plans} {falls} short of the best by {'less than 0.01' if short < 0.01 else f'{short:.2f}'} % of what there"
        f" is to be had, under the weights that suit {'it' if len(found.plans) == 1 else 'them'} best."
    ]
    names, weights = [each.name for each in found.terms], found.weights(found.centre)
    idle = [j for j in range(len(names)) if found.spread[j] == 0]
    open_ = [j for j in range(len(names)) if j not in found.identifiable and j not in idle]
    reference = next((j for j, weight in enumerate(weights.tolist()) if weight == 1.0), None)
    for j in found.identifiable:
        worth = ""
        if reference is not None and j != reference and math.isfinite(weights[j]):
            unit = found.terms[reference].unit
            worth = f"; a unit of it is worth {number(float(weights[j]))} {unit} of what is {names[reference]}"
        said.append(
            f"The weight of {names[j]} is found: {100 * found.low[j]:.3g} to {100 * found.high[j]:.3g} % of all{worth}."
        )
    for j in open_:
        ends = f"{100 * found.low[j]:.3g} to {100 * found.high[j]:.3g} %"
        said.append(f"The weight of {names[j]} cannot be told closely: all from {ends} fit.")
    if idle:
        said.append(
            f"Of {joined_text([names[j] for j in idle])} there is no telling: nothing that can be done changes it."
        )
    return said


def weights_table(found: ObjectiveWeights) -> Table:
    """Return one row a term: the range of its weight, as share of all, and the middle of the cone."""
    table = Table(title=f"weights under which the plan is within {100 * found.within:.3g} % of the best")
    for heading in ("term", "least", "most", "centre", "per unit", "unit"):
        table.add_column(heading, justify="left" if heading in ("term", "unit") else "right")
    for row in _rows(found):
        ends = ("–", "–", "–") if row[4] == 0 else tuple(f"{100 * share:.3g} %" for share in row[5:8])
        table.add_row(str(row[0]), *ends, "–" if not math.isfinite(row[8]) else f"{row[8]:.4g}", str(row[2]))
    return table


def write_weights(found: ObjectiveWeights, path: Path) -> Path:
    """Write the table as CSV, whole or not at all, and return its path; missing folders are made."""
    header = ["term", "kind", "unit", "about", "to be had", "least share", "most share", "centre", "weight per unit"]
    header += ["share under which plans are best", "distance from the best"]
    rows = [[*row, f"{found.best[j]:.10g}", f"{found.distance:.10g}"] for j, row in enumerate(_rows(found))]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda partial: write_table(partial, header, rows))
    return path


def _rows(found: ObjectiveWeights) -> list[tuple[str, str, str, str, float, float, float, float, float]]:
    weights = found.weights(found.centre)
    return [
        (
            each.name, each.kind, each.unit, each.about, float(found.spread[j]), float(found.low[j]),
            float(found.high[j]), float(found.centre[j]), float(weights[j]),
        )
        for j, each in enumerate(found.terms)
    ]  # fmt: skip
