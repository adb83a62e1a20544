"""Plans that can be carried out: among those of equal worth the one nearest to business as usual, with least change.

Many plans reach nearly the same λ̄, and the corner of a program that a solver ends in is seldom one that anybody would
follow. A second program holds λ̄ and every service where they are, within TOLERANCE, and minimises ::

    Σ_k ( mean_t |u_kt − n_kt| + Σ_t |u_kt − u_k,t−1| ) / w_k,

with u the values of the controls, n those of business as usual, and w_k the widest range of control k. The sum of
changes may not grow. It is solved around the episode that the simulator makes, again and again (``linearised``), and a
step counts once the simulator confirms it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy import sparse

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.environments.actuators import Actuators
from cirl_marl.errors import CirlError, instance_of
from cirl_marl.network import Floats, Network
from cirl_marl.optimum.bounds import Bound
from cirl_marl.optimum.linearised import step_program
from cirl_marl.optimum.planned_episodes import simulate_plan
from cirl_marl.optimum.program import LinearProgram
from cirl_marl.optimum.slopes import MOST_SLOPES, Slopes, jacobians, slopes_of
from cirl_marl.optimum.solver import best_values

TOLERANCE = 1e-4
"""What a plan may lose of λ̄ and of the level of each service, relative to them."""
MISSES = 5
"""Most programs in turn around episodes that lose more."""
ROUNDS = 16
"""Most programs that are solved."""
GAIN = 1e-2
"""Relative fall of the distance below which no further program is solved."""
MOST_ROWS = 20_000
"""Rows of the program up to which plans are smooth unless they are asked not to be."""
SMALLEST = 1e-3
"""Smallest half-width of the region that a program is for, in normalised actions; the first has all of them."""


def program_rows(network: Network) -> int:
    """Return the number of equations of the second program: of each stock and flow in each interval."""
    return network.episode.horizon * (Dynamics(network).rows.nodes.stop + len(network.arcs))


class Distance:
    """How far actions are from business as usual, and how much they change, in shares of the range of each control.

    Attributes:
        neutral: business as usual, shape (steps, entries).
        half: what an action of 1 adds to one of 0, likewise.
    """

    def __init__(self, bound: Bound) -> None:
        """Take the controls of those who act in ``bound``."""
        steps, entries = bound.actions.shape
        self._actuators = actuators = Actuators(bound.network, bound.agents or None, steps)
        self._interval = np.arange(steps)
        self._width = np.ones(entries)
        low, high = (self.values(np.full((steps, entries), end)) for end in (-1.0, 1.0))
        width = (high - low).max(axis=0)
        self._width = np.where(width > 0, width, 1.0)
        self.neutral: Floats = bound.network.control_bounds[1, actuators.control_rows].T / self._width
        self.half: Floats = (high - low) / 2 / self._width

    def values(self, actions: Floats) -> Floats:
        """Return the values of the controls, in shares of their ranges, shape (steps, entries)."""
        controls = self._actuators.controls(np.ascontiguousarray(actions.T), self._interval)
        return controls[self._actuators.control_rows].T / self._width

    def changes(self, actions: Floats) -> float:
        """Return the sum of the changes from interval to interval."""
        return float(np.abs(np.diff(self.values(actions), axis=0)).sum())

    def __call__(self, actions: Floats) -> float:
        """Return the mean distance from business as usual, of all controls together, and the sum of the changes."""
        return float(np.abs(self.values(actions) - self.neutral).mean(axis=0).sum()) + self.changes(actions)


class _Episode:
    """An episode of the simulator under some actions, and its Jacobians once they are asked for."""

    def __init__(self, bound: Bound, dynamics: Dynamics) -> None:
        self.bound, self.run, self._dynamics = bound, simulate_plan(bound), dynamics

    @cached_property
    def slopes(self) -> Slopes:
        return jacobians(self.bound, self._dynamics)


def smooth_plan(bound: Bound, *, progress: Callable[[float], None] = lambda share: None) -> Bound:
    """Return ``bound`` with actions that do as well, nearer to business as usual and with less change.

    In the simulator λ̄ and the mean level of each service fall by TOLERANCE at most, and the sum of changes does not
    grow. The bound and its certificate stay.

    Args:
        bound: with the actions to start from, such as those of ``improve_plan``.
        progress: called with the share of ROUNDS that is done; 1 when no more are needed.

    Raises:
        CirlError: for a network so large that its Jacobians would have more than MOST_SLOPES entries.
    """
    dynamics, distance = Dynamics(instance_of(Bound, "bound", bound).network), Distance(bound)
    if slopes_of(bound.actions.shape, dynamics) > MOST_SLOPES:
        size = f"its Jacobians have {slopes_of(bound.actions.shape, dynamics):,} entries, more than {MOST_SLOPES:,}"
        raise CirlError(f"network '{bound.network.name}': plans cannot be made smooth, as {size}")
    reference = best = centre = _Episode(bound, dynamics)
    value, most, trust, misses = distance(bound.actions), distance.changes(bound.actions), 2.0, 0
    exact = margin = np.zeros_like(reference.run.levels[0])
    for done in range(ROUNDS):
        if trust < SMALLEST:
            break
        nearest = _nearer(centre, reference, dynamics, distance, most, trust / 2**misses, margin, restore=misses > 0)
        progress((done + 1) / ROUNDS)
        if nearest is None or distance(actions := nearest[0]) >= value:
            centre, trust, misses, margin = best, trust / 4, 0, exact
            continue
        centre = _Episode(replace(bound, actions=actions), dynamics)
        if _as_good(centre, reference):
            gain = 1 - distance(actions) / value
            best, value, misses, margin = centre, distance(actions), 0, exact
            if gain < GAIN:
                break
        elif misses < MISSES:  # the program around it brings back what was lost
            lack = np.maximum(nearest[1].T - centre.run.levels[0], 0.0)
            misses, margin = misses + 1, margin + np.where(lack <= TOLERANCE, lack, 0.0)
        else:
            centre, trust, misses, margin = best, trust / 4, 0, exact
    progress(1.0)
    return best.bound


def _as_good(trial: _Episode, reference: _Episode) -> bool:
    """Whether an episode keeps λ̄, the level of each service and a weighted objective within TOLERANCE."""
    run, standard, aims = trial.run, reference.run, trial.bound.aims
    value, weight = aims.value(standard), trial.bound.service_weight or 0.0
    loss = value - aims.value(run)
    lack = max(0.0, float(standard.episode_service[0] - run.episode_service[0]))
    price = weight * trial.bound.network.objective.circularity_scale
    is_served = run.episode_levels[0] >= standard.episode_levels[0] * (1 - TOLERANCE)
    most = np.maximum(aims.limits, aims.totals(standard))
    is_kept = (aims.totals(run) <= most + TOLERANCE * np.abs(most)).all()
    return max(loss, loss + price * lack) <= TOLERANCE * abs(value) and bool(is_served.all() and is_kept)


def _nearer(
    centre: _Episode,
    reference: _Episode,
    dynamics: Dynamics,
    distance: Distance,
    most: float,
    trust: float,
    margin: Floats,
    *,
    restore: bool,
) -> tuple[Floats, Floats] | None:
    """Return the nearest actions that are as good to first order, and their levels; None if HiGHS finds none.

    Shapes are (steps, entries) and (steps, services).

    Args:
        centre: the episode that the program is around.
        reference: whose λ̄ and services count; half of what λ̄ may lose is left for what the program does not see.
        dynamics: of the network.
        distance: what is minimised.
        most: sum of the changes that is allowed.
        trust: half-width of the region, in normalised actions.
        margin: by how much more of each service is asked for, as trials had less than was promised.
        restore: whether to bring back what ``centre`` lost already.
    """
    run, aims = centre.run, centre.bound.aims
    value, limits = aims.value(reference.run), np.maximum(aims.limits, aims.totals(reference.run))
    levels, slack = reference.run.episode_levels[0], aims.value(run) - value
    slack += TOLERANCE / 2 * abs(value)
    if not restore:
        levels, slack = np.minimum(levels, run.episode_levels[0]), max(0.0, slack)
        limits = np.maximum(limits, aims.totals(run))
    plain = replace(centre.bound, service_weight=None)
    price = np.zeros(len(levels) + len(limits))
    program = step_program(plain, dynamics, run, levels, price, trust, centre.slopes, margin, limits, is_held=True)
    problem, columns, actions = program.problem, program.columns, centre.bound.actions
    count, controls, entries = len(program.origin), actions.size, actions.shape[1]
    pick = sparse.csr_array((distance.half.ravel(), (np.arange(controls), columns.action.ravel())), (controls, count))
    # ±(u − n) ≤ m, ±(u_t − u_{t−1}) ≤ c, Σ c ≤ most, and λ̄ falls by no more than the slack
    change = sparse.eye_array(controls - entries, controls, k=entries) - sparse.eye_array(controls - entries, controls)
    away, rise = -sparse.eye_array(controls), -sparse.eye_array(controls - entries)
    under = sparse.block_array(
        [
            [problem.under, None, None],
            [pick, away, None],
            [-pick, away, None],
            [change @ pick, None, rise],
            [-change @ pick, None, rise],
            [problem.cost[None], None, None],
            [None, None, np.ones((1, controls - entries))],
        ],
        format="csr",
    )
    values = distance.values(actions).ravel()
    offset, before, last = values - distance.neutral.ravel(), change @ values, [problem.cost @ program.origin + slack]
    added, high = len(values) + len(before), problem.high.copy()
    high[columns.lack] = 0.0
    second = LinearProgram(
        cost=np.concatenate([np.zeros(count), np.full(controls, 1.0 / len(actions)), np.ones(len(before))]),
        equal=sparse.hstack([problem.equal, sparse.csr_array((len(problem.equal_to), added))], format="csr"),
        equal_to=problem.equal_to,
        under=under,
        under_to=np.concatenate([problem.under_to, -offset, offset, -before, before, last, [most]]),
        low=np.append(problem.low, np.zeros(added)),
        high=np.append(high, np.full(added, np.inf)),
    )
    solution = best_values(second, np.append(program.scale, np.ones(added)))
    if solution is None:
        return None
    return np.clip(actions + solution[columns.action], -1.0, 1.0), solution[columns.level]
