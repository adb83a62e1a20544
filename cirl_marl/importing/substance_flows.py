"""Substances in the flows of a table: what rows state of them, what does not balance, and the closest that does."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from scipy.optimize import nnls

from cirl_marl.errors import CirlError, first_lines
from cirl_marl.importing.grids import GridPart, plain_text
from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.units import factor

EXACT = 1e-9
"""Part of the mass by which balances and limits may be missed, as sums round."""


@positional_record
class SubstanceFlows:
    """Amounts of substances in the flows of a table; what is not in the table is 0."""

    names: Annotated[tuple[str, ...], "in the order of the file"]
    amounts: Annotated[Floats, "shape (substances, regions, years, pairs), mass/time"]
    deviations: Annotated[Floats, "standard deviations, NaN where none is stated, likewise"]
    is_content: Annotated[
        Floats, "1 where a part of the flow was stated, 0 where an amount was, NaN elsewhere, likewise"
    ]

    def of_flows(self, before: Floats, after: Floats) -> SubstanceFlows:
        """Return the substances of flows that were adjusted, (regions, years, pairs): contents stay what they were."""
        ratio = np.divide(after, before, out=np.ones_like(after), where=before > 0)
        scale = np.where(self.is_content > 0, ratio, 1.0)
        return SubstanceFlows(self.names, self.amounts * scale, self.deviations * scale, self.is_content)

    def part(self, regions: Integers, years: slice, pairs: Integers) -> SubstanceFlows:
        """Return what there is of some regions, years and pairs."""
        tables = (self.amounts, self.deviations, self.is_content)
        return SubstanceFlows(self.names, *(table[:, regions][:, :, years][..., pairs] for table in tables))

    def non_zero(self) -> SubstanceFlows | None:
        """Return the substances of which there is any, or None."""
        places = np.flatnonzero(self.amounts.any(axis=(1, 2, 3)))
        tables = (self.amounts, self.deviations, self.is_content)
        names = tuple(self.names[place] for place in places.tolist())
        return SubstanceFlows(names, *(table[places] for table in tables)) if names else None


@dataclass
class SubstanceRows:
    """The rows of a long table that are of substances, as they are read."""

    entries: list[tuple[str, int, str, str, Integers, float, float]] = field(default_factory=list)

    def take(self, part: GridPart, unit: str, places: Integers, values: Floats, deviations: Floats) -> None:
        """Take rows of which ``places`` are region, year and pair; ``unit`` is that of rows that state none."""
        units = [text.strip() or unit for text in part.of("unit")]
        names = map(plain_text, part.of("substance"))
        rows = zip(names, part.lines, units, places.T, values.tolist(), deviations.tolist(), strict=True)
        self.entries += ((name, line, part.grid.name, *row) for name, line, *row in rows)

    def flows(
        self, grid: Floats, first_year: int, unit: str, stated_unit: str, regions: Sequence[str], labels: Sequence[str]
    ) -> SubstanceFlows:
        """Return the substances in flows, shape (regions, years, pairs), mass/time in ``unit``.

        Args:
            grid: the flows, NaN where the table states none.
            first_year: of the table.
            unit: of the flows.
            stated_unit: of rows that state none.
            regions: their names.
            labels: names of the pairs.

        Raises:
            CirlError: naming the lines of substances in what does not flow, that stand twice, or have a wrong unit, or
                a year of which nothing is told while there are others.
        """
        names = tuple(dict.fromkeys(name for name, *_ in self.entries))
        amounts, lines = np.zeros((len(names), *grid.shape)), np.zeros((len(names), *grid.shape), dtype=np.intp)
        deviations, is_content = np.full((2, *amounts.shape), np.nan)
        faults: list[str] = []
        for name, line, sheet, text, (region, year, pair), value, deviation in self.entries:
            place = names.index(name), region, year - first_year, pair
            flow, subject = _cell(grid, place[1:]), f"{sheet}, line {line}: {name} of {labels[pair]} in {year}"
            if np.isnan(flow):
                faults.append(f"{subject}: there is no such flow; give the flow itself in a row without substance")
                continue
            if lines[place]:
                faults.append(f"{subject} stands in line {lines[place]} too; leave one out")
            try:
                scale, is_part = amount_scale(text or stated_unit, unit)
            except CirlError as error:
                faults.append(f"{sheet}, line {line}: {error}")
                continue
            if is_part and value * scale > 1 + EXACT:
                faults.append(f"{subject}: {value:g} {text or stated_unit} is more than there is; check its unit")
                continue
            scale *= flow if is_part else 1.0
            amounts[place], deviations[place] = value * scale, deviation * scale
            is_content[place], lines[place] = is_part, line
        if faults:
            raise CirlError("\n".join(first_lines(faults)))
        is_told, flows_at_all = (lines > 0).any(axis=3), np.asarray(grid > 0).any(axis=2)
        is_told_ever = np.any(is_told, axis=2, keepdims=True)
        for e, r, y in np.argwhere(is_told_ever & ~is_told & flows_at_all).tolist():
            year = f"{first_year + y} in {regions[r]}" if regions[r] else str(first_year + y)
            sheet = self.entries[0][2]
            raise CirlError(f"{sheet}: no row says what there is of {names[e]} in {year}; say it, if only that it is 0")
        return SubstanceFlows(names, amounts, deviations, is_content)


def _cell(grid: Floats, place: tuple[int, ...]) -> float:
    within = all(0 <= i < size for i, size in zip(place, grid.shape, strict=True))
    return float(grid[place]) if within else np.nan


def amount_scale(text: str, unit: str) -> tuple[float, bool]:
    """Return by what an amount in a unit is multiplied, and whether it is a part of the whole, in ``unit``."""
    faults = []
    for target in ("1", unit, unit.removesuffix("/year")):
        try:
            return factor(text, target), target == "1"
        except CirlError as error:
            faults.append(error)
    raise CirlError(f"{faults[1]}; of a substance give a part, as in % or ppm, or an amount in {unit}")


def mixed_amounts(amounts: Floats, flow: Floats, incidence: Floats, silent: Integers) -> Floats:
    """Return amounts with what processes hand on that mix: of what enters, x_k = f_k/Σf·Σ_in x, a linear system.

    Args:
        amounts: of a substance in the flows of a year, 0 where nothing is known, shape (pairs,).
        flow: in which they are, likewise.
        incidence: −1 where a pair leaves, 1 where it enters a process, shape (processes, pairs).
        silent: processes of whose outflows nothing is known.
    """
    leaves, enters = np.maximum(-incidence[silent], 0.0), np.maximum(incidence[silent], 0.0)
    whole = leaves @ flow
    shares = np.divide(leaves * flow, whole[:, None], out=np.zeros_like(leaves), where=whole[:, None] > 0)
    through = np.linalg.lstsq(np.eye(len(silent)) - enters @ shares.T, enters @ amounts, rcond=None)[0]
    return np.asarray(amounts + shares.T @ through)


def excesses(amounts: Floats, flows: Floats) -> Iterator[tuple[int, int, int]]:
    """Yield the places of flows, (regions, years, pairs), in which there is more of all substances than the flow."""
    limit = flows * (1 + EXACT) + EXACT * flows.max(initial=0.0)
    yield from map(tuple, np.argwhere(amounts.sum(axis=0) > limit).tolist())


def closest_amounts(amounts: Floats, deviations: Floats, flow: Floats, balances: Floats) -> Floats | None:
    """Return amounts of all substances in the flows of a year that balance and are closest; None if there are none.

    They minimise Σ ((x − m)/σ)² for balances·x_e = 0 of each substance e, x ≥ 0 and Σ_e x_e ≤ flow. Where σ = 0 x is
    m. Each substance is measured by its own largest amount, so that traces balance as well as what there is most of.
    In the deviations z the equalities leave z = z₀ + N y, z₀ the shortest solution, and what is left is the least y
    within inequalities, which non-negative least squares solve (Lawson and Hanson 1974, ch. 23, LDP).

    Args:
        amounts: m, shape (substances, pairs), mass/time.
        deviations: σ, likewise.
        flow: of which they are parts, shape (pairs,), mass/time.
        balances: what enters less what leaves processes without stock, shape (processes, pairs).
    """
    largest = amounts.max(axis=1, keepdims=True)
    size = np.where(largest > 0, largest, 1.0)
    spread, start, whole = (deviations / size).ravel(), (amounts / size).ravel(), float(flow.max(initial=0.0)) or 1.0
    free = np.flatnonzero(spread > 0)
    of_each = np.kron(np.eye(len(amounts)), balances)
    equal, equal_to = (of_each * spread)[:, free], -of_each @ start
    limits = np.concatenate([-part * np.eye(len(flow)) for part in (size / whole).ravel()], axis=1)
    rows = np.concatenate([np.eye(len(start)), limits])
    under, under_to = (rows * spread)[:, free], np.concatenate([-start, -flow / whole - limits @ start])
    left, values, right = np.linalg.svd(equal)
    rank = int((values > EXACT * values.max(initial=0.0)).sum())
    shortest = right[:rank].T @ (left[:, :rank].T @ equal_to / values[:rank])
    if np.abs(equal @ shortest - equal_to).max(initial=0.0) > 1e-7:
        return None
    slack, null = under_to - under @ shortest, right[rank:].T
    change = _shortest_within(under @ null, slack)
    if change is None:
        return None
    result = start.copy()
    result[free] += spread[free] * (shortest + null @ change)
    return np.maximum(result, 0.0).reshape(amounts.shape) * size


def _shortest_within(rows: Floats, least: Floats) -> Floats | None:
    """Return the shortest y with rows·y ≥ least; None if there is none."""
    tolerance = EXACT * 1e-2
    if (least <= tolerance).all():
        return np.zeros(rows.shape[1])
    norm = np.linalg.norm(rows, axis=1)
    if (least[norm <= tolerance] > 1e-7).any():
        return None
    is_row = norm > tolerance
    rows, least = rows[is_row] / norm[is_row, None], least[is_row] / norm[is_row]
    height = float(np.abs(least).max())
    system = np.concatenate([rows.T, least[None] / height])
    target = np.append(np.zeros(rows.shape[1]), 1.0)
    residual = system @ nnls(system, target)[0] - target
    if residual[-1] > -1e-9:
        return None
    return np.asarray(-residual[:-1] / residual[-1] * height)


def degrees_of_freedom(deviations: Floats, balances: Floats) -> int:
    """Return how many independent balances of substances have uncertain amounts, (substances, pairs)."""
    return sum(int(np.linalg.matrix_rank(balances[:, row > 0])) for row in deviations)
