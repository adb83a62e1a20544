"""From plans to aims: which weights of circularity, services and set-points make given plans (close to) optimal.

Of an episode v let φ_j(v) be the terms. A plan v̂ is within ε of the best for the weights w if

    Σ_j w_j (φ_j(v) − φ_j(v̂)) ≤ ε    for every v that satisfies the rows of the program of ``bound``.

These are infinitely many linear inequalities in (w, ε), which are found as they are needed: for some w a linear program
gives the v that breaks one most. So the set of weights is a polyhedral cone, known from outside at every moment: it
never loses weights that fit. Its ends are found by going as far as possible in each weight, until no v objects.

References: Ahuja and Orlin 2001, Inverse optimization, Operations Research 49, 771.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linprog

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Network
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.certificate import verify
from cirl_marl.optimum.options import DEGREE
from cirl_marl.optimum.program import Programs
from cirl_marl.optimum.solver import Basis, solve
from cirl_marl.reasons.objective_terms import KINDS, ObjectiveTerm, PlannedEpisode, objective_terms
from cirl_marl.reasons.plans import episode_setting, episodes_of_plan

WITHIN = 0.01
ROUNDS = 200
"""Most programs that are solved for one end of the cone."""
CLOSE = 1e-6
"""Share of what there is to be had by which a weight may be wrong about an inequality."""
NARROW = 0.1
"""Width of a weight's range, relative to its middle, up to which it counts as found."""
NOTHING = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectiveWeights:
    """The weights under which plans are within a distance of the best.

    Weights are shares u_j = w_j S_j, Σ u = 1, S_j being how much of a term there is to be had: from the least to the
    most of it in the plans and in what is best for single terms.

    Attributes:
        network: the network.
        plans: names of the plans.
        terms: what may be aimed at.
        spread: S_j, shape (terms,); 0 for a term that nothing changes, of which no plan can tell the weight.
        low: least share of each that fits, shape (terms,).
        high: greatest share.
        centre: the mean of the ends, a share of each that fits.
        best: the shares under which the plans are closest to the best.
        distance: by how much they fall short of it under these, as share of what there is to be had; proved.
        within: distance up to which weights fit.
        cuts: the inequalities that were found, Σ u_j cut_j ≤ distance, shape (cuts, terms).
        solved: programs that were solved.
    """

    network: Network
    plans: tuple[str, ...]
    terms: tuple[ObjectiveTerm, ...]
    spread: Floats
    low: Floats
    high: Floats
    centre: Floats
    best: Floats
    distance: float
    within: float
    cuts: Floats
    solved: int

    def fits(self, weights: ArrayLike) -> bool:
        """Whether weights w_j ≥ 0 of the terms, in their own units, break none of the inequalities."""
        given = np.asarray(weights, dtype=float)
        shares = given * self.spread if given.shape == self.spread.shape else np.zeros(0)
        if not shares.sum() > 0 or (shares < 0).any():
            raise CirlError(f"weights {weights!r}: needs one for each of {len(self.terms)} terms, none negative")
        return bool((self.cuts @ (shares / shares.sum())).max(initial=0.0) <= self.within + CLOSE)

    def weights(self, shares: Floats) -> Floats:
        """Return weights per unit of each term, the largest share of a part of λ having 1; NaN for idle terms."""
        natural = np.divide(shares, self.spread, out=np.full(len(shares), np.nan), where=self.spread > 0)
        parts = [j for j, each in enumerate(self.terms) if each.kind == "circularity" and self.spread[j] > 0]
        first = max(parts, key=lambda j: shares[j], default=int(np.argmax(shares)))
        found: Floats = natural / natural[first] if natural[first] > 0 else natural
        return found

    @property
    def identifiable(self) -> list[int]:
        """Terms whose weight the plans tell: the range is at most a tenth of its middle."""
        middle = (self.low + self.high) / 2
        return [j for j in range(len(self.terms)) if self.high[j] - self.low[j] <= NARROW * middle[j]]


class _WeighedPlan:
    """One plan, with the program of what could have been done from its start."""

    def __init__(self, programs: Programs, weighed: Sequence[ObjectiveTerm], course: PlannedEpisode) -> None:
        admissible = programs.admissible
        network, lifetimes = admissible.lifetimes.network, admissible.lifetimes
        steps = network.episode.horizon
        tangents = [term.tangent(network, course) for term in weighed]
        self._problem = replace(programs.program(course.initial), constant=0.0)
        self._columns = np.array([each.columns(programs.layout, lifetimes, steps) for each in tangents])
        self.value = np.array([each.of(network, course) for each in tangents])
        self._basis: Basis | None = None

    def against(self, weights: Floats) -> tuple[Floats, float]:
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
        progress: called with the share that is done.

    Raises:
        NoCertificate: for a network for which no bound is proved.
        CirlError: for input that cannot be used, or a solver that fails.
        RunError: for a run of another network.
    """
    if not 0 <= within < 1:
        raise CirlError(f"within {within!r} must be at least 0 and less than 1")
    if episodes < 1:
        raise CirlError(f"episodes must be at least 1, got {episodes}")
    known = (load_network(network) if isinstance(network, str | Path) else network).scenario(scenario)
    given = [plans] if isinstance(plans, str | Path | PlannedEpisode) else list(plans)
    if not given:
        raise CirlError("infer: no plans were given")
    known, agents = episode_setting(known, given)
    weighed = tuple(objective_terms(known, kinds))
    programs = Programs(Admissible.of(known, agents), DEGREE, None)
    every: list[PlannedEpisode] = []
    for each in given:
        every += (
            [each] if isinstance(each, PlannedEpisode) else episodes_of_plan(known, each, seed=seed, episodes=episodes)
        )
    for course in every:
        _check_shape(known, course)
    cone = _Cone([_WeighedPlan(programs, weighed, course) for course in every], len(weighed), progress)
    spread = cone.spread
    best, distance = cone.closest()
    allowed = distance + within
    low, high, corners = cone.ends(allowed)
    progress(1.0)
    return ObjectiveWeights(
        network=known,
        plans=tuple(course.name for course in every),
        terms=weighed,
        spread=spread,
        low=low,
        high=high,
        centre=np.mean(corners, axis=0),
        best=best,
        distance=distance,
        within=allowed,
        cuts=cone.cuts,
        solved=cone.solved,
    )


def _check_shape(network: Network, course: PlannedEpisode) -> None:
    steps = network.episode.horizon
    shapes = (steps, len(network.stores)), (steps, len(network.arcs))
    if (course.stock.shape, course.flow.shape) != shapes:
        raise CirlError(
            f"{course.name}: has stocks {course.stock.shape} and flows {course.flow.shape}, but an episode of"
            f" '{network.name}' has {shapes[0]} and {shapes[1]}"
        )


class _Cone:
    """The inequalities that are known, and those that are yet to be found."""

    def __init__(self, plans: Sequence[_WeighedPlan], count: int, progress: Callable[[float], None]) -> None:
        self._plans, self._count, self._progress = plans, count, progress
        self.solved = 0
        reached: list[tuple[int, Floats]] = []
        for p, plan in enumerate(plans):
            for j in range(count):
                reached.append((p, plan.against(np.eye(count)[j])[0]))
                self.solved += 1
                progress(0.3 * self.solved / (len(plans) * count))
        points = np.array([*(each for _, each in reached), *(plan.value for plan in plans)])
        spread = points.max(axis=0) - points.min(axis=0)
        size = np.abs(points).max(axis=0)
        self.spread = np.where(spread > 1e-7 * size + NOTHING, spread, 0.0)
        self._moves = self.spread > 0
        if not self._moves.any():
            raise CirlError("infer: nothing that can be done changes any of the terms")
        self._rows = [self._row(p, each) for p, each in reached]

    @property
    def cuts(self) -> Floats:
        """All inequalities, shape (cuts, terms)."""
        return np.array(self._rows)

    def _row(self, plan: int, terms_: Floats) -> Floats:
        gain = terms_ - self._plans[plan].value
        row: Floats = np.divide(gain, self.spread, out=np.zeros_like(gain), where=self._moves)
        return row

    def _worst(self, shares: Floats) -> float:
        """Look for what breaks inequalities most for some shares; return by how much the plans are off, proved."""
        weights = np.divide(shares, self.spread, out=np.zeros_like(shares), where=self._moves)
        worst = 0.0  # a plan that is outside of what the rows allow may be better than all of it
        for p, plan in enumerate(self._plans):
            reached, most = plan.against(weights)
            self.solved += 1
            self._rows.append(self._row(p, reached))
            worst = max(worst, most - float(weights @ plan.value))
        return worst

    def closest(self) -> tuple[Floats, float]:
        """Return the shares under which plans are closest to the best, and how far they are then."""
        best, least = np.zeros(self._count), np.inf
        for _ in range(ROUNDS):
            shares, promised = self._solved(np.append(np.zeros(self._count), 1.0), None)
            found = self._worst(shares)
            if found < least:
                best, least = shares, found
            if least <= promised + CLOSE:
                break
        self._progress(0.4)
        return best, least

    def ends(self, allowed: float) -> tuple[Floats, Floats, list[Floats]]:
        """Return the least and the greatest share of each term, and the shares at which they are reached."""
        low, high, corners = np.zeros(self._count), np.zeros(self._count), list[Floats]()
        low[~self._moves], high[~self._moves] = 0.0, 1.0
        moving = np.flatnonzero(self._moves)
        for place, j in enumerate(moving.tolist()):
            for way, ends in ((1.0, low), (-1.0, high)):
                for _ in range(ROUNDS):
                    shares, _ = self._solved(np.append(way * np.eye(self._count)[j], 0.0), allowed)
                    if self._worst(shares) <= allowed + CLOSE:
                        break
                ends[j] = shares[j]
                corners.append(shares)
            self._progress(0.4 + 0.6 * (place + 1) / len(moving))
        return low, high, corners

    def _solved(self, cost: Floats, allowed: float | None) -> tuple[Floats, float]:
        """Return shares, and the distance, that minimise a cost under the inequalities that are known."""
        rows = np.concatenate([self.cuts, np.full((len(self._rows), 1), -1.0)], axis=1)
        limits = [(0.0, 1.0 if moves else 0.0) for moves in self._moves]
        last = (0.0, None) if allowed is None else (0.0, allowed)
        total = np.append(self._moves.astype(float), 0.0)[None]
        found = linprog(cost, A_ub=rows, b_ub=np.zeros(len(rows)), A_eq=total, b_eq=[1.0], bounds=[*limits, last])
        if not found.success:
            raise CirlError(f"infer: no weights satisfy what was found: {found.message}")
        shares = np.maximum(found.x[:-1], 0.0)
        return shares / shares.sum(), float(found.x[-1])
