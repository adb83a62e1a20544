"""The program of some intervals of an episode: what is to be planned, and what its rows have beside those of a bound.

A demanded level is no row that must hold but has a price, charged per unit that the episode lacks. A price above the
multiplier of the demand is exact: nothing is lacking that can be had.

Reference: Kerrigan and Maciejowski 2000, UKACC Control (exact penalties in model predictive control).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, fields, replace
from typing import Annotated, Any

import numpy as np
from scipy import sparse

from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.program import Program
from cirl_marl.optimum.solver import Basis, Solution

EMPTY = np.empty(0)
DISTANCE = 0.1
"""What is charged for stocks at the end of a window that are not those of the plan of the episode, of their price."""


@positional_record
class Correction:
    """What became of a plan in the simulator, by interval."""

    error: Annotated[Floats, "(q̂ − q)/l of each service, shape (intervals, services)"]
    excess: Annotated[
        Floats,
        "what was booked beyond the plan, evenly over those that count, in parts of budgets, (intervals, budgets)",
    ]
    through: Annotated[Floats, "Q̂ − Q of each node that orders leave, shape (intervals, nodes), mass/time"]
    rate: Annotated[Floats, "flow over what drives it, planned, shape (intervals, arcs), 1/time"]
    valve: Annotated[Floats, "planned valve of each node, shape (intervals, nodes)"]

    def of(self, places: Integers) -> Correction:
        """Return that of other intervals, of which each is taken to be like one of these."""
        return Correction(*(getattr(self, part.name)[places] for part in fields(self)))


@positional_record
class Continuation:
    """What comes after a window, as a plan of the whole episode had it."""

    costs: Annotated[Floats, "that later rows charge for the variables of the window, shape (intervals, variables)"]
    stocks: Annotated[Floats, "at the end of the window, shape (stores,), mass"]


@positional_record
class WindowTask:
    """What is to be planned."""

    stock: Annotated[Floats, "at the start, by stage as the simulator has it, shape (rows,), mass"]
    intervals: Annotated[range, "of the episode"]
    demand: Annotated[Floats | None, "mean level of each service over these, shape (services,); None for none"]
    later: Annotated[Continuation | None, "what comes after; None at the end of the episode"]
    price: Annotated[
        Floats,
        "of each budget by which it is exceeded, in parts of it, and of a unit of each service that the episode lacks, "
        "shape (budgets + services,)",
    ]
    corrections: Annotated[
        tuple[Correction, ...] | None, "of a plan before, by future; None: controls may vary within an interval"
    ]
    is_outlook: Annotated[bool, "whether the multipliers must be good, as they are the prices of later plans"] = False
    is_redrawn: Annotated[bool, "whether other futures are planned for than before"] = False
    limits: Annotated[Floats, "highest totals over these, in parts of budgets; empty for none"] = field(
        default_factory=lambda: EMPTY
    )
    charges: Annotated[Floats, "of the total of each budgeted account, in parts of budgets; empty for none"] = field(
        default_factory=lambda: EMPTY
    )

    @property
    def has_to_serve(self) -> bool:
        """Whether demands and budgets hold here, whatever they cost, not at a price beside that of later intervals."""
        return self.later is None and not self.is_redrawn


@positional_record
class WindowPlan:
    """A plan of a window, which exists in the simulator."""

    task: Annotated[WindowTask, "what was planned, at the price that was needed"]
    problem: Annotated[Program, "the program"]
    solution: Annotated[Solution, "its optimum"]
    actions: Annotated[Floats, "normalised, in the first of the futures, shape (intervals, entries)"]
    corrections: Annotated[tuple[Correction, ...], "what became of it in each future"]
    levels: Annotated[
        Floats, "that the program promises, or actions found otherwise reach, on average, shape (intervals, services)"
    ]
    level: Annotated[Floats, "mean of each service that was reached, shape (services,)"]
    bookings: Annotated[Floats, "on budgeted accounts, on average, in parts of budgets, shape (intervals, budgets)"]
    value: Annotated[float, "objective reached there, less what is left to later intervals"]
    merit: Annotated[float, "objective reached there, less what is left to later intervals and what service lacks"]

    @property
    def charges(self) -> Floats:
        """What a unit more of each budget is worth to the plan, in parts of it, shape (budgets,)."""
        multipliers = self.solution.certificate.under[len(self.problem.under_to) - len(self.task.price) :]
        return np.maximum(-multipliers[: len(self.task.limits)], 0.0)

    def basis(self, intervals: range) -> Basis | None:
        """Return the basis from which to plan ``intervals``; None if they are neither as many nor the last of these."""
        own, basis = self.task.intervals, self.solution.basis
        if basis is None or len(intervals) == len(own):
            return basis
        if len(self.corrections) > 1 or intervals.stop != own.stop or intervals.start < own.start:
            return None
        return basis.without_first(self.problem, intervals.start - own.start)

    def actions_of(self, intervals: range) -> Floats:
        """Return the actions in other ``intervals``, in later ones the last, shape (intervals, entries)."""
        ahead = np.arange(intervals.start, intervals.stop) - self.task.intervals.start
        return np.asarray(self.actions[np.minimum(ahead, len(self.actions) - 1)])

    def corrections_of(self, intervals: range, futures: int) -> tuple[Correction, ...]:
        """Return what is expected of other ``intervals``: what became of these, the last of them from there on.

        As other futures are drawn then, of several it is the mean: what is done in the first interval is one thing.
        """
        own, corrections = self.task.intervals, self.corrections
        places = np.clip(np.arange(intervals.start, intervals.stop) - own.start, 0, len(own) - 1)
        correction = corrections[0]
        if len(corrections) > 1:
            parts = ([getattr(each, part.name) for each in corrections] for part in fields(correction))
            correction = Correction(*(np.mean(part, axis=0) for part in parts))
        return (correction.of(places),) * futures

    def continuation(self, intervals: range) -> Continuation:
        """Return what comes after some of the intervals, as planned here.

        Its costs are the terms of c − Aᵀy − Gᵀμ that belong to rows of later intervals: a price on each stock at the
        end and, where products have a lifetime, on what goes into use, which is discarded later.
        """
        problem, certificate, layout = self.problem, self.solution.certificate, self.problem.layout
        first, stop = (end - self.task.intervals.start for end in (intervals.start, intervals.stop))
        own = slice(first * layout.size, stop * layout.size)
        costs, budgets = np.zeros(own.stop - own.start), len(self.task.limits)
        last = len(problem.under_to) - len(self.task.price) + budgets
        for matrix, multipliers in ((problem.equal, certificate.equal), (problem.under, certificate.under)):
            later = problem.interval_of_rows(matrix) >= stop
            if matrix is problem.under:  # what is booked has its charges
                later[last - budgets : last] = False
            costs -= matrix[later][:, own].T @ multipliers[later]
        by_interval = costs.reshape(len(intervals), layout.size)
        if self.solution.basis is None:  # multipliers that are only nearly right would pay for more than is demanded
            by_interval[:, layout.level : layout.imbalance] = 0.0
        ends = self.solution.plan[(stop - 1) * layout.size : stop * layout.size][layout.last]
        return Continuation(by_interval, np.maximum(ends, 0.0))


def level_columns(problem: Program) -> Integers:
    """Return the variable of each level, shape (intervals · services,)."""
    layout = problem.layout
    first = np.arange(len(problem.cost) // layout.size)[:, None] * layout.size
    columns: Integers = (first + np.arange(layout.level, layout.imbalance)).ravel()
    return columns


def level_rows(problem: Program) -> tuple[Integers, Integers, Floats]:
    """Return the rows of G that hold levels, where nothing is demanded: which, of which level, and with what weight.

    Levels are numbered as in ``level_columns``; shapes are (rows,).
    """
    matrix = problem.under.tocsc()[:, level_columns(problem)]
    matrix.sort_indices()
    places, holds = np.repeat(np.arange(matrix.shape[1]), np.diff(matrix.indptr)), matrix.data > 0
    return matrix.indices[holds], places[holds], matrix.data[holds]


def with_distance(problem: Program, later: Continuation) -> Program:
    """Return the program in which stocks at the end cost DISTANCE of their price for what parts them from the plan's.

    Its two new variables for each are what they have more, and less.
    """
    layout, stores, rows = problem.layout, len(later.stocks), len(problem.equal_to)
    last = np.arange(layout.last.start, layout.last.stop) + len(problem.cost) - layout.size
    ends = sparse.csr_array((np.ones(stores), (np.arange(stores), last)), shape=(stores, len(problem.cost)))
    parts = sparse.hstack([-sparse.eye_array(stores), sparse.eye_array(stores)])
    price = DISTANCE * np.abs(later.costs[-1, layout.last])
    return replace(
        problem,
        cost=np.concatenate([problem.cost, price, price]),
        equal=sparse.block_array([[problem.equal, sparse.csr_array((rows, 2 * stores))], [ends, parts]], format="csr"),
        equal_to=np.append(problem.equal_to, later.stocks),
        under=sparse.hstack([problem.under, sparse.csr_array((len(problem.under_to), 2 * stores))], format="csr"),
        low=np.append(problem.low, np.zeros(2 * stores)),
        high=np.concatenate([problem.high, problem.high[last], later.stocks]),
    )


@positional_record
class JointProgram:
    """The programs of a window in several futures as one, in which what is done in the first interval is the same."""

    problem: Annotated[Program, "minimises the mean of their costs"]
    parts: Annotated[tuple[Program, ...], "the programs"]
    columns: Annotated[tuple[Integers, ...], "of the variables of each"]

    @classmethod
    def of(
        cls, parts: Sequence[Program], demand: Floats | None, bookings: Sequence[Any] = (), limits: Floats = EMPTY
    ) -> JointProgram:
        """Put programs together whose first intervals are alike.

        The last rows of G hold budgets, then services; what is exceeded or lacks are the last variables.

        Args:
            parts: programs without a demand.
            demand: mean level of each service over intervals and futures, shape (services,); None if nothing is
                demanded.
            bookings: rows of totals over the variables of each part, shape (budgets, variables), sparse.
            limits: highest of their means, shape (budgets,); empty for none.
        """
        common, count = parts[0].layout.size, len(parts)
        sizes = [len(part.cost) for part in parts]
        tops = np.cumsum([common, *(size - common for size in sizes)])
        columns = tuple(
            np.concatenate([np.arange(common), np.arange(top, top + size - common)])
            for top, size in zip(tops.tolist(), sizes, strict=False)
        )
        width = int(tops[-1])
        places = [
            sparse.csr_array((np.ones(len(own)), (np.arange(len(own)), own)), shape=(len(own), width))
            for own in columns
        ]
        problem = parts[0]
        if count > 1:
            cost, low, high = np.zeros(width), np.full(width, -np.inf), np.full(width, np.inf)
            for part, own in zip(parts, columns, strict=True):
                cost[own] += part.cost / count
                low[own], high[own] = np.maximum(low[own], part.low), np.minimum(high[own], part.high)
            pairs = list(zip(parts, places, strict=True))
            problem = replace(
                problem,
                cost=cost,
                equal=sparse.vstack([part.equal @ place for part, place in pairs], format="csr"),
                equal_to=np.concatenate([part.equal_to for part in parts]),
                under=sparse.vstack([part.under @ place for part, place in pairs], format="csr"),
                under_to=np.concatenate([part.under_to for part in parts]),
                low=low,
                high=high,
            )
        most = EMPTY  # that budgets may be exceeded by, and services lack
        if len(limits):
            totals = sum(rows @ place / count for rows, place in zip(bookings, places, strict=True))
            most = np.maximum(abs(totals) @ np.maximum(np.abs(problem.low), np.abs(problem.high)) - limits, 0.0)
            under = sparse.vstack([problem.under, totals], format="csr")
            problem = replace(problem, under=under, under_to=np.append(problem.under_to, limits))
        if demand is not None and len(demand):
            levels = [level_columns(part) for part in parts]
            weight = -1.0 / (len(levels[0]) // len(demand) * count)
            rows = [np.tile(np.arange(len(demand)), len(level) // len(demand)) for level in levels]
            means = sum(
                sparse.csr_array((np.full(len(level), weight), (row, own[level])), shape=(len(demand), width))
                for level, row, own in zip(levels, rows, columns, strict=True)
            )
            means.sort_indices()
            under = sparse.vstack([problem.under, means], format="csr")
            problem = replace(problem, under=under, under_to=np.append(problem.under_to, -demand))
            most = np.append(most, np.maximum(demand, 0.0) + 1.0)  # levels are at least −1
        return cls(with_lack(problem, most) if len(most) else problem, tuple(parts), columns)


def with_lack(problem: Program, most: Floats) -> Program:
    """Return the program in which the last rows of G may lack something, at ``most`` so much, one variable each."""
    rows, slack_count = len(problem.under_to), len(most)
    lack = -sparse.eye_array(rows, slack_count, k=slack_count - rows, format="csr")
    empty = sparse.csr_array((len(problem.equal_to), slack_count))
    return replace(
        problem,
        cost=np.append(problem.cost, np.zeros(slack_count)),
        equal=sparse.hstack([problem.equal, empty], format="csr"),
        under=sparse.hstack([problem.under, lack], format="csr"),
        low=np.append(problem.low, np.zeros(slack_count)),
        high=np.append(problem.high, most),
    )
