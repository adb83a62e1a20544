"""From plans to aims: which weights of circularity, services and set-points make given plans (close to) optimal.

Of an episode v let φ_j(v) be the terms. A plan v̂ is within ε of the best for the weights w if

    Σ_j w_j (φ_j(v) − φ_j(v̂)) ≤ ε    for every v that satisfies the rows of the program of ``bound``.

These are infinitely many linear inequalities in (w, ε), which are found as they are needed: for some w a linear program
gives the v that breaks one most. So the set of weights is a polyhedral cone, known from outside at every moment: it
never loses weights that fit. Its ends are found by going as far as possible in each weight, until no v objects.

References: Ahuja and Orlin 2001, Inverse optimization, Operations Research 49, 771.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linprog

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.errors import CirlError, whole_number
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import frozen_record
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.certificate import verify
from cirl_marl.optimum.options import DEGREE
from cirl_marl.optimum.program import Programs
from cirl_marl.optimum.solver import Basis, solve
from cirl_marl.reasons.objective_terms import KINDS, ObjectiveTerm, PlannedEpisode, objective_terms
from cirl_marl.reasons.plan_files import episode_setting, episodes_of_plan

WITHIN = 0.01
ROUNDS = 200
"""Most programs that are solved for one end of the cone."""
CLOSE = 1e-6
"""Share of what there is to be had by which a weight may be wrong about an inequality."""
NARROW = 0.1
"""Width of a weight's range, relative to its middle, up to which it counts as found."""
TINY = 1e-9
SECONDS = 60.0
"""Processor time in which programs are begun."""


@frozen_record
class ObjectiveWeights:
    """The weights under which plans are within a distance of the best.

    Weights are shares u_j = w_j S_j, Σ u = 1, S_j being how much of a term there is to be had: from the least to the
    most of it in the plans and in what is best for single terms.
    """

    network: Annotated[Network, "the network"]
    plans: Annotated[tuple[str, ...], "names of the plans"]
    terms: Annotated[tuple[ObjectiveTerm, ...], "what may be aimed at"]
    spread: Annotated[
        Floats,
        "S_j, shape (terms,); 0 for a term that nothing changes, of which no plan can tell the weight, or that nothing"
        " has changed until time ran out",
    ]
    low: Annotated[Floats, "least share of each that fits, shape (terms,)"]
    high: Annotated[Floats, "greatest share"]
    centre: Annotated[Floats, "the mean of the ends, a share of each that fits"]
    best: Annotated[Floats, "the shares under which the plans are closest to the best"]
    distance: Annotated[
        float,
        "by how much they fall short of it under these, as share of what there is to be had; proved",
    ]
    within: Annotated[float, "distance up to which weights fit"]
    cuts: Annotated[Floats, "the inequalities that were found, Σ u_j cut_j ≤ distance, shape (cuts, terms)"]
    programs: Annotated[int, "how many programs were solved"]
    finished: Annotated[
        bool, "False if time ran out: ranges are those of the programs so far, and the distance may be less"
    ]

    def fits(self, weights: ArrayLike) -> bool:
        """Whether weights w_j ≥ 0 of the terms, in their own units, break none of the inequalities."""
        per_unit = np.asarray(weights, dtype=float)
        shares = per_unit * self.spread if per_unit.shape == self.spread.shape else np.zeros(0)
        if not shares.sum() > 0 or (shares < 0).any():
            raise CirlError(f"weights {weights!r}: needs one for each of {len(self.terms)} terms, none negative")
        return bool((self.cuts @ (shares / shares.sum())).max(initial=0.0) <= self.within + CLOSE)

    def weights(self, shares: Floats) -> Floats:
        """Return weights per unit of each term, the largest share of a part of λ having 1; NaN for idle terms."""
        per_unit: Floats = np.divide(shares, self.spread, out=np.full(len(shares), np.nan), where=self.spread > 0)
        parts = [j for j, term in enumerate(self.terms) if term.kind == "circularity" and self.spread[j] > 0]
        reference = per_unit[max(parts, key=lambda j: shares[j], default=int(np.argmax(shares)))]
        return per_unit / reference if reference > 0 else per_unit

    @property
    def identifiable(self) -> list[int]:
        """Terms whose weight the plans tell: the range is at most a tenth of its middle."""
        middle = (self.low + self.high) / 2
        return [j for j in range(len(self.terms)) if self.high[j] - self.low[j] <= NARROW * middle[j]]


class _PlanProgram:
    """One plan, with the program of what could have been done from its start."""

    def __init__(self, programs: Programs, terms: Sequence[ObjectiveTerm], plan: PlannedEpisode) -> None:
        lifetimes = programs.admissible.lifetimes
        network = lifetimes.network
        tangents = [term.tangent(network, plan) for term in terms]
        self._problem = replace(programs.program(plan.initial), constant=0.0)
        steps = network.episode.horizon
        self._columns = np.array([tangent.columns(programs.layout, lifetimes, steps) for tangent in tangents])
        self.value = np.array([tangent.of(network, plan) for tangent in tangents])
        self._basis: Basis | None = None

    def maximise(self, weights: Floats) -> tuple[Floats, float]:
        """Return the terms of an episode that is best for weights, and what no episode exceeds."""
        problem = replace(self._problem, cost=-(weights @ self._columns))
        solution = solve(problem, self._basis, label="the program of the best for some weights", same_rows=True)
        self._basis = solution.basis or self._basis
        proof = verify(problem, solution.certificate, solution.plan)
        return self._columns @ solution.plan, proof.bound


def infer(
    network: str | Path | Network,
    plans: Sequence[str | Path | PlannedEpisode] | str | Path | PlannedEpisode,
    *,
    kinds: Sequence[str] = KINDS,
    within: float = WITHIN,
    scenario: str | None = None,
    seed: int | None = None,
    episodes: int = 4,
    seconds: float = SECONDS,
    progress: Callable[[float], None] = lambda share: None,
) -> ObjectiveWeights:
    """Return the weights under which plans are (close to) optimal.

    Args:
        network: catalogue name, path of a definition file, or a network.
        plans: CSV files of ``cirl plan`` or ``cirl simulate``, run directories, or episodes; several narrow the cone.
        kinds: what may be aimed at, of KINDS.
        within: how far from the best plans may be, as share of what there is to be had, beyond the distance that no
            weights avoid. Bounds are relaxations, and plans seldom reach them, so 0 fits plans of the program itself.
        scenario: of the definition.
        seed: of the start of plans that ``cirl plan`` wrote with one; of the episodes of a run.
        episodes: that are taken of a run.
        seconds: of processor time; a program that may not end in it is not begun, but for a first one, and one of
            each plan. What was found by then holds.
        progress: called with the share that is done.

    Raises:
        NoCertificate: for a network for which no bound is proved.
        CirlError: for input that cannot be used, or a solver that fails.
        RunError: for a run of another network.
    """
    if not 0 <= within < 1:
        raise CirlError(f"within {within!r} must be at least 0 and less than 1")
    whole_number("episodes", episodes, 1)
    stop = time.process_time() + seconds
    network = load_network(network, scenario=scenario)
    sources = [plans] if isinstance(plans, str | Path | PlannedEpisode) else list(plans)
    if not sources:
        raise CirlError("infer: no plans were given")
    network, agents = episode_setting(network, sources)
    terms = tuple(objective_terms(network, kinds))
    programs = Programs(Admissible.of(network, agents), DEGREE, None)
    planned_episodes: list[PlannedEpisode] = []
    for source in sources:
        if isinstance(source, PlannedEpisode):
            planned_episodes.append(source)
        else:
            planned_episodes += episodes_of_plan(network, source, seed=seed, episodes=episodes)
    steps = network.episode.horizon
    shapes = (steps, len(network.stores)), (steps, len(network.arcs))
    for plan in planned_episodes:
        if (plan.stock.shape, plan.flow.shape) != shapes:
            raise CirlError(
                f"{plan.name}: has stocks {plan.stock.shape} and flows {plan.flow.shape}, but an episode of"
                f" '{network.name}' has {shapes[0]} and {shapes[1]}"
            )
    cone = _Cone([_PlanProgram(programs, terms, plan) for plan in planned_episodes], len(terms), stop, progress)
    best, distance = cone.closest()
    low, high, corners = cone.ends(distance + within)
    progress(1.0)
    return ObjectiveWeights(
        network=network,
        plans=tuple(plan.name for plan in planned_episodes),
        terms=terms,
        spread=cone.spread,
        low=low,
        high=high,
        centre=np.mean(corners, axis=0),
        best=best,
        distance=distance,
        within=distance + within,
        cuts=cone.cuts,
        programs=cone.programs,
        finished=cone.finished,
    )


class _Cone:
    """The inequalities that are known, and those that are yet to be found."""

    def __init__(
        self, plans: Sequence[_PlanProgram], count: int, stop: float, progress: Callable[[float], None]
    ) -> None:
        self._plans, self._count, self._stop, self._progress = plans, count, stop, progress
        self.finished, self._longest = True, 0.0
        self.programs = 0
        extremes: list[tuple[int, Floats]] = []
        for p, plan in enumerate(plans):
            for unit in np.eye(count):
                if extremes and self._late(reserve=len(plans)):
                    break
                extremes.append((p, self._maximise(plan, unit)[0]))
                progress(0.3 * self.programs / (len(plans) * count))
        points = np.array([*(point for _, point in extremes), *(plan.value for plan in plans)])
        spread = points.max(axis=0) - points.min(axis=0)
        size = np.abs(points).max(axis=0)
        self.spread = np.where(spread > 1e-7 * size + TINY, spread, 0.0)
        self._moves = self.spread > 0
        if not self._moves.any():
            reason = "nothing that can be done changes any of the terms"
            raise CirlError(f"infer: {reason if self.finished else 'time ran out before anything was found'}")
        self._rows = [self._row(p, point) for p, point in extremes]

    @property
    def cuts(self) -> Floats:
        """All inequalities, shape (cuts, terms)."""
        return np.array(self._rows)

    def _per_spread(self, values: Floats) -> Floats:
        """Divide by how much of each term there is to be had; 0 for what nothing changes."""
        return np.asarray(np.divide(values, self.spread, out=np.zeros_like(values), where=self._moves))

    def _row(self, plan: int, point: Floats) -> Floats:
        return self._per_spread(point - self._plans[plan].value)

    def _worst(self, shares: Floats) -> float:
        """Look for what breaks inequalities most for some shares; return by how much the plans are off, proved."""
        weights = self._per_spread(shares)
        worst = 0.0  # a plan that is outside of what the rows allow may be better than all of it
        for p, plan in enumerate(self._plans):
            point, bound = self._maximise(plan, weights)
            self._rows.append(self._row(p, point))
            worst = max(worst, bound - float(weights @ plan.value))
        return worst

    def closest(self) -> tuple[Floats, float]:
        """Return the shares under which plans are closest to the best, and how far they are then."""
        best, least = np.zeros(self._count), np.inf
        for _ in range(ROUNDS):
            shares, outside = self._minimise(np.append(np.zeros(self._count), 1.0), None)
            distance = self._worst(shares)
            if distance < least:
                best, least = shares, distance
            if least <= outside + CLOSE or self._late():
                break
        self._progress(0.4)
        return best, least

    def ends(self, distance: float) -> tuple[Floats, Floats, list[Floats]]:
        """Return the least and the greatest share of each term within a distance, and the shares where they are."""
        low, high, corners = np.zeros(self._count), np.where(self._moves, 0.0, 1.0), list[Floats]()
        movable = np.flatnonzero(self._moves).tolist()
        for place, j in enumerate(movable):
            for sign, ends in ((1.0, low), (-1.0, high)):
                cost = np.append(sign * np.eye(self._count)[j], 0.0)
                for _ in range(ROUNDS):
                    shares, _ = self._minimise(cost, distance)
                    if self._late() or self._worst(shares) <= distance + CLOSE:
                        break
                ends[j] = shares[j]
                corners.append(shares)
            self._progress(0.4 + 0.6 * (place + 1) / len(movable))
        return low, high, corners

    def _late(self, reserve: int = 0) -> bool:
        """Whether time may run out before one program more, and some in reserve, are solved.

        The inequalities that are known hold nevertheless, so that ranges are only too wide.
        """
        late = time.process_time() + (1 + reserve) * self._longest > self._stop
        self.finished &= not late
        return late

    def _maximise(self, plan: _PlanProgram, weights: Floats) -> tuple[Floats, float]:
        begin = time.process_time()
        best = plan.maximise(weights)
        self.programs, self._longest = self.programs + 1, max(self._longest, time.process_time() - begin)
        return best

    def _minimise(self, cost: Floats, most: float | None) -> tuple[Floats, float]:
        """Return shares, and the distance, that minimise a cost under the inequalities that are known."""
        rows = np.concatenate([self.cuts, np.full((len(self._rows), 1), -1.0)], axis=1)
        limits = [(0.0, 1.0 if moves else 0.0) for moves in self._moves]
        total = np.append(self._moves.astype(float), 0.0)[None]
        bounds = [*limits, (0.0, most)]
        solution = linprog(cost, A_ub=rows, b_ub=np.zeros(len(rows)), A_eq=total, b_eq=[1.0], bounds=bounds)
        if not solution.success:
            raise CirlError(f"infer: no weights satisfy what was found: {solution.message}")
        shares = np.maximum(solution.x[:-1], 0.0)
        return shares / shares.sum(), float(solution.x[-1])
