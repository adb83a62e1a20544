"""Weights that plans reveal, as a table and in sentences."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from rich.table import Table

from cirl_marl.drawing.style import number
from cirl_marl.reasons.inverse import ObjectiveWeights
from cirl_marl.reasons.sentences import joined_text
from cirl_marl.records.files import write_table
from cirl_marl.report.terminal import text_table


def weights_sentences(weights: ObjectiveWeights) -> list[str]:
    """Say how far the plans are from the best, which weights they tell, and which they do not."""
    plans, falls, object_ = "This plan", "falls", "it"
    if len(weights.plans) > 1:
        plans, falls, object_ = f"These {len(weights.plans)} plans", "fall", "them"
    distance = "less than 0.01" if 100 * weights.distance < 0.01 else f"{100 * weights.distance:.2f}"
    shortfall = f"{plans} {falls} short of the best by {distance} % of what there is to be had"
    sentences = [f"{shortfall}, under the weights that suit {object_} best."]
    if not weights.finished:
        sentences.append(f"Time ran out after {weights.programs} programs: more time may narrow what follows.")
    names, per_unit = [term.name for term in weights.terms], weights.weights(weights.centre)
    spans = [(f"{100 * low:.3g}", f"{100 * high:.3g} %") for low, high in zip(weights.low, weights.high, strict=True)]
    idle = [j for j in range(len(names)) if weights.spread[j] == 0]
    reference = next((j for j, weight in enumerate(per_unit.tolist()) if weight == 1.0), None)
    for j in weights.identifiable:
        worth = ""
        if reference is not None and j != reference and math.isfinite(per_unit[j]):
            unit = weights.terms[reference].unit
            worth = f"; a unit of it is worth {number(float(per_unit[j]))} {unit} of what is {names[reference]}"
        sentences.append(f"The weight of {names[j]} is found: {' to '.join(spans[j])} of all{worth}.")
    for j, name in enumerate(names):
        if j not in weights.identifiable and j not in idle:
            sentences.append(f"The weight of {name} cannot be told closely: all from {' to '.join(spans[j])} fit.")
    if not weights.identifiable:
        reason = "the search was not finished; give it more time, or fewer --terms."
        if weights.finished:
            remedy = "Give plans of other starts or networks, fewer --terms, or a smaller --within."
            reason = f"many weights leave these plans within {100 * weights.within:.3g} % of the best. {remedy}"
        sentences.append(f"No weight is identified: {reason}")
    if idle:
        idle_names = joined_text([names[j] for j in idle])
        late = "time ran out before anything changed it, so it is left out"
        reason = "nothing that can be done changes it" if weights.finished else late
        sentences.append(f"Of {idle_names} there is no telling: {reason}.")
    return sentences


def weights_table(weights: ObjectiveWeights) -> Table:
    """Return one row a term: the range of its weight, as share of all, and the middle of the cone."""
    rows = []
    for name, _, unit, _, spread, *shares, per_unit in _rows(weights):
        ends = ["–"] * 3 if spread == 0 else [f"{100 * share:.3g} %" for share in shares]
        rows.append([name, *ends, f"{per_unit:.4g}" if math.isfinite(per_unit) else "–", unit])
    title = f"weights under which the plan is within {100 * weights.within:.3g} % of the best"
    return text_table(title, ["term", "least", "most", "centre", "per unit", "unit"], rows, text=["term", "unit"])


def write_weights(weights: ObjectiveWeights, path: Path) -> Path:
    """Write the table as CSV, whole or not at all, and return its path; missing folders are made."""
    header = ["term", "kind", "unit", "about", "to be had", "least share", "most share", "centre", "weight per unit"]
    header += ["share under which plans are best", "distance from the best"]
    distance = f"{weights.distance:.10g}"
    rows = [[*row, f"{best:.10g}", distance] for row, best in zip(_rows(weights), weights.best, strict=True)]
    return write_table(path, header, rows)


def _rows(weights: ObjectiveWeights) -> list[tuple[Any, ...]]:
    columns = (weights.spread, weights.low, weights.high, weights.centre, weights.weights(weights.centre))
    rows = zip(weights.terms, *(column.tolist() for column in columns), strict=True)
    return [(term.name, term.kind, term.unit, term.about, *figures) for term, *figures in rows]
