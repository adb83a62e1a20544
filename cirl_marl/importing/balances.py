"""What processes of a table of flows are, what does not balance, and the flows closest to it that do."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from enum import StrEnum
from typing import Annotated

import numpy as np
from scipy.special import chdtrc

from cirl_marl.errors import CirlError
from cirl_marl.importing.flow_table import Connection, FlowTable
from cirl_marl.importing.substance_flows import (
    closest_amounts,
    degrees_of_freedom,
    excesses,
    mixed_amounts,
)
from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import positional_record

ROUNDING = 1e-6
"""Part of the largest flow of a region by which a process may fail to balance, as tables are rounded."""
GROWS = 0.2
"""Part of all that enters a process from which on what stays there is taken for a growing stock."""
UNCERTAIN = 0.1
"""Standard deviation, relative to the flow, of flows that state none."""
SWEEPS = 1000


class ProcessKind(StrEnum):
    """What a process does with what enters it."""

    SOURCE = "source"
    SINK = "sink"
    TRANSIT = "passing"
    STORE = "store"


@positional_record
class Residual:
    """What entered a process and did not leave it, though it is no store."""

    process: Annotated[str, "its name"]
    region: Annotated[str, "empty without regions"]
    year: Annotated[int, "the year"]
    inflow: Annotated[float, "sum of its inflows"]
    outflow: Annotated[float, "sum of its outflows"]
    substance: Annotated[str, "of which; empty: of the whole"] = ""

    def __str__(self) -> str:
        """Say it as in a message."""
        place = _place(self.region, self.year, self.substance)
        return f"'{self.process}' ({place}): {self.inflow:g} enter, {self.outflow:g} leave"


@positional_record
class Change:
    """A flow that was adjusted."""

    region: Annotated[str, "empty without regions"]
    year: Annotated[int, "the year"]
    pair: Annotated[Connection, "the flow"]
    before: Annotated[float, "as the table has it"]
    after: Annotated[float, "as it was adjusted"]
    deviation: Annotated[float, "standard deviation that it was weighted by"]
    substance: Annotated[str, "of which; empty: of the whole"] = ""

    @property
    def place(self) -> str:
        """Where and when it is, and of what."""
        return _place(self.region, self.year, self.substance)

    @property
    def in_deviations(self) -> float:
        """The change in standard deviations."""
        return (self.after - self.before) / self.deviation


@positional_record
class Reconciliation:
    """What was changed so that flows balance, and how well that agrees with their uncertainties."""

    changes: Annotated[tuple[Change, ...], "flows that were adjusted"]
    chi_square: Annotated[float, "Σ ((x − m)/σ)² over all flows"]
    degrees: Annotated[int, "its degrees of freedom: independent balances of flows that are uncertain"]

    @property
    def p_value(self) -> float:
        """Probability of so large a χ², or a larger one, if the flows balance and err as stated."""
        return float(chdtrc(self.degrees, self.chi_square)) if self.degrees else 1.0

    @property
    def far(self) -> list[Change]:
        """Flows that were moved by more than two standard deviations, the furthest first."""
        return sorted((c for c in self.changes if abs(c.in_deviations) > 2), key=lambda c: -abs(c.in_deviations))

    def __add__(self, addend: Reconciliation) -> Reconciliation:
        """Return all changes of both, as one."""
        chi_square, degrees = self.chi_square + addend.chi_square, self.degrees + addend.degrees
        return Reconciliation(self.changes + addend.changes, chi_square, degrees)


class Processes:
    """The processes of a table.

    Attributes:
        table: the flows.
        names: in the order in which the table names them.
        kinds: what each is.
        inferred_stores: stores that nobody named as such, found by what stays in them.
    """

    def __init__(self, table: FlowTable, stores: Collection[str] = ()) -> None:
        """Find out what each process of ``table`` is.

        ``stores`` hold a stock; if none is named, those do in which much of what enters stays.
        """
        self.table, self._stores = table, stores
        self.names = tuple(dict.fromkeys(end for pair in table.pairs for end in (pair.source, pair.target)))
        self._place = {name: i for i, name in enumerate(self.names)}
        self.flows = table.grid(table.values)
        self._incidence = np.zeros((len(self.names), len(table.pairs)))
        for k, pair in enumerate(table.pairs):
            self._incidence[self._place[pair.source], k] -= 1.0
            self._incidence[self._place[pair.target], k] += 1.0
        inflow, outflow = self._sums(1.0, self.flows), self._sums(-1.0, self.flows)
        stays = inflow - outflow
        beyond = np.abs(stays) > _rounding(self.flows)
        whole = inflow.sum(axis=(0, 1))
        grows = stays.sum(axis=(0, 1)) >= GROWS * whole
        self.kinds: dict[str, ProcessKind] = {}
        inferred = []
        for i, name in enumerate(self.names):
            if whole[i] == 0:
                kind = ProcessKind.SOURCE
            elif not outflow[:, :, i].any():
                kind = ProcessKind.SINK
            elif name in stores:
                kind = ProcessKind.STORE
            elif not stores and beyond[:, :, i].any() and grows[i]:
                kind = ProcessKind.STORE
                inferred.append(name)
            else:
                kind = ProcessKind.TRANSIT
            self.kinds[name] = kind
        self.inferred_stores = tuple(inferred)
        self._transit = np.array([kind is ProcessKind.TRANSIT for kind in self.kinds.values()])
        self._balances = self._incidence[self._transit]

    def of(self, *kinds: ProcessKind) -> tuple[str, ...]:
        """Return the processes of some kinds."""
        return tuple(name for name, kind in self.kinds.items() if kind in kinds)

    @property
    def residuals(self) -> list[Residual]:
        """What does not balance beyond rounding, of the whole and of substances, the largest first."""
        substances = self.table.substances
        tables = {} if substances is None else dict(zip(substances.names, substances.amounts, strict=True))
        residuals = [
            residual for name, flows in {"": self.flows, **tables}.items() for residual in self._off(name, flows)
        ]
        return sorted(residuals, key=lambda residual: -abs(residual.inflow - residual.outflow))

    def _off(self, substance: str, flows: Floats) -> Iterator[Residual]:
        inflow, outflow = self._sums(1.0, flows), self._sums(-1.0, flows)
        wrong = (np.abs(inflow - outflow) > _rounding(flows)) & self._transit
        regions, years = self.table.regions, self.table.years
        for r, y, i in np.argwhere(wrong).tolist():
            yield Residual(self.names[i], regions[r], years[y], inflow[r, y, i], outflow[r, y, i], substance)

    def mix_substances(self) -> Processes:
        """Return the processes, with what those without stock hand on of a substance of which no outflow says anything.

        They mix what enters. These amounts are as uncertain as they are large.
        """
        table, substances = self.table, self.table.substances
        if substances is None:
            return self
        amounts, deviations = substances.amounts.copy(), substances.deviations.copy()
        for place in np.ndindex(amounts.shape[:3]):
            silent = self._silent(place)
            leaves = (self._incidence[silent] < 0).any(axis=0)
            amounts[place][leaves] = 0.0
            amounts[place] = mixed_amounts(amounts[place], self.flows[place[1:]], self._incidence, silent)
            deviations[place][leaves] = amounts[place][leaves]
        mixed = replace(table, substances=replace(substances, amounts=amounts, deviations=deviations))
        return Processes(mixed, self._stores)

    def _silent(self, place: tuple[int, ...]) -> Integers:
        """Return the processes without stock of whose outflows nothing is told; of a substance, region and year."""
        assert self.table.substances is not None
        is_told = np.isfinite(self.table.substances.is_content[place])
        return np.flatnonzero(self._transit & ~((np.maximum(-self._incidence, 0.0) @ is_told) > 0))

    def check_contents(self) -> None:
        """Refuse flows in which there is more of substances than they are; a ``CirlError`` names the first."""
        table = self.table
        if table.substances is None:
            return
        for r, y, k in excesses(table.substances.amounts, self.flows):
            place = _place(table.regions[r], table.years[y])
            parts = zip(table.substances.names, table.substances.amounts[:, r, y, k].tolist(), strict=True)
            listing = " and ".join(f"{amount:g} {name}" for name, amount in parts if amount)
            flow = f"{table.pairs[k]} ({place}): {listing} in {self.flows[r, y, k]:g} {table.unit}"
            raise CirlError(f"{table.name}: {flow}: no more than all of it; correct the table, or give --reconcile")

    def reconcile(self) -> tuple[Processes, Reconciliation]:
        """Return flows that balance and are closest to those of the table, what was changed, and how plausible that is.

        In each region and year they minimise Σ ((x − m)/σ)² for x ≥ 0 and inflow = outflow of every process that
        stores nothing, m the flows of the table and σ their standard deviations, or 10 % of flows that state none
        (Cencic and Rechberger 2008). A flow of 0 stays 0.
        """
        table, flows = self.table, self.flows.copy()
        stated_deviations = table.grid(table.deviations, np.nan)
        balances, changes, chi_square, degrees = self._balances, [], 0.0, 0
        for r, region in enumerate(table.regions):
            for y, year in enumerate(table.years):
                table_flow = self.flows[r, y]
                stated = stated_deviations[r, y]
                deviations = np.where(np.isnan(stated), UNCERTAIN * table_flow, stated)
                closest = _closest(table_flow, np.where(table_flow > 0, deviations, 0.0), balances)
                if closest is None:
                    fault = "flows whose uncertainty is 0 do not balance; state how uncertain they are"
                    raise CirlError(f"{table.name}: {_place(region, year)}: {fault}")
                free = (deviations > 0) & (table_flow > 0)
                chi_square += float((((closest - table_flow)[free] / deviations[free]) ** 2).sum())
                degrees += int(np.linalg.matrix_rank(balances[:, free])) if free.any() else 0
                for k in np.flatnonzero(np.abs(closest - table_flow) > 1e-9 * table_flow.max()).tolist():
                    flows[r, y, k] = after = float(closest[k])
                    changes.append(Change(region, year, table.pairs[k], table_flow[k], after, float(deviations[k])))
        substances = table.substances
        if substances is not None:
            substances = substances.of_flows(self.flows, flows)
        balanced_table = replace(table, values=flows[table.cells], substances=substances)
        return Processes(balanced_table, self.of(ProcessKind.STORE)), Reconciliation(
            tuple(changes), chi_square, degrees
        )

    def reconcile_substances(self) -> tuple[Processes, Reconciliation]:
        """Return substances that balance, are closest to those of the table and within the flows, and what was changed.

        The flows stay: each substance balances at every process without stock, and all are together at most the flow
        (``closest_amounts``). Deviations are as those of flows, 10 % of amounts
        that state none.
        """
        table, substances = self.table, self.table.substances
        assert substances is not None
        sizes = substances.amounts.max(axis=3)
        stated, before = substances.deviations, substances.amounts
        deviations = np.where(before > 0, np.where(np.isnan(stated), UNCERTAIN * before, stated), 0.0)
        amounts, changes, chi_square, degrees = before.copy(), [], 0.0, 0
        for r, region in enumerate(table.regions):
            for y, year in enumerate(table.years):
                spread, measured = deviations[:, r, y], before[:, r, y]
                closest = closest_amounts(measured, spread, self.flows[r, y], self._balances)
                if closest is None:
                    fault = f"no amounts of {' and '.join(substances.names)} balance within the flows"
                    raise CirlError(f"{table.name}: {_place(region, year)}: {fault}; state how uncertain they are")
                amounts[:, r, y] = closest
                change = np.divide(closest - measured, spread, out=np.zeros_like(closest), where=spread > 0)
                chi_square += float((change**2).sum())
                degrees += degrees_of_freedom(spread, self._balances)
                for e, k in np.argwhere(np.abs(closest - measured) > 1e-9 * sizes[:, r, y, None]).tolist():
                    cells = float(measured[e, k]), float(closest[e, k]), float(spread[e, k])
                    changes.append(Change(region, year, table.pairs[k], *cells, substances.names[e]))
        balanced_table = replace(table, substances=replace(substances, amounts=amounts))
        return Processes(balanced_table, self.of(ProcessKind.STORE)), Reconciliation(
            tuple(changes), chi_square, degrees
        )

    def stock_mistakes(self, stocks: Mapping[tuple[str, str, int], float]) -> dict[str, float]:
        """Return, for each process with stocks, the largest difference between their growth and what the flows say.

        The stock of a year is that at its end; stocks are by region, process and year.
        """
        worst: dict[str, float] = {}
        table, net = self.table, self.flows @ self._incidence.T
        for (region, name, year), stock in stocks.items():
            before = stocks.get((region, name, year - 1))
            if before is not None and year in table.years:
                growth = float(net[table.regions.index(region), table.years.index(year), self._place[name]])
                worst[name] = max(worst.get(name, 0.0), abs(stock - before - growth))
        return worst

    def _sums(self, sign: float, flows: Floats) -> Floats:
        """Return what enters (1) or leaves (−1) each process, shape (regions, years, processes)."""
        ends = np.maximum(sign * self._incidence, 0.0)
        return np.asarray(flows @ ends.T)


def _rounding(flows: Floats) -> Floats:
    """Return what counts as rounding in each region, shape (regions, 1, 1)."""
    return np.asarray(ROUNDING * flows.max(axis=(1, 2), keepdims=True))


def _place(region: str, year: int, substance: str = "") -> str:
    return ", ".join(filter(None, (region, str(year), substance)))


def _closest(table_flow: Floats, deviations: Floats, balances: Floats) -> Floats | None:
    """Return the x ≥ 0 with ``balances`` x = 0 that minimises Σ ((x − m)/σ)², by an active set; None if there is none.

    Where σ = 0 x is m.
    """
    free, flow = deviations > 0, table_flow.copy()
    scale = float(table_flow.max(initial=0.0)) or 1.0
    for _ in range(SWEEPS):
        weights = np.where(free, deviations**2, 0.0)
        start = np.where(free | (deviations == 0), table_flow, 0.0)
        system = (balances * weights) @ balances.T
        prices = np.linalg.lstsq(system, balances @ start, rcond=1e-13)[0]
        flow = start - weights * (balances.T @ prices)
        if (flow < -1e-12 * scale).any():
            free &= flow >= -1e-12 * scale
            continue
        # what would rise if it were let go
        at_zero = ~free & (deviations > 0)
        pull = np.where(at_zero, table_flow - deviations**2 * (balances.T @ prices), -np.inf)
        if pull.max(initial=-np.inf) <= 1e-9 * scale:
            break
        free[int(pull.argmax())] = True
    flow = np.maximum(flow, 0.0)
    return flow if np.abs(balances @ flow).max(initial=0.0) <= 1e-7 * scale else None
