"""Prices that leave a clairvoyant little use of foresight, fitted to draws of their own.

What stocks are worth in the optima of some draws is regressed on what is new about the disturbances. From there, and
from no prices at all, prices on stocks and on services are improved together by cutting planes in a box: what is proved
on average is convex in them, and the optimum of every draw gives a subgradient. Draws kept apart choose among what was
tried. Whatever prices come out, what they prove of other draws is a bound.

References: Brown and Smith 2014, Information relaxations, duality, and convex stochastic dynamic programs (gradients as
penalties); Marsten, Hogan and Blankenship 1975, The boxstep method for large-scale optimization.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, sparse

from cirl_marl.errors import CirlError
from cirl_marl.network import Floats
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.aims import budget_texts
from cirl_marl.optimum.certificate import Certificate
from cirl_marl.optimum.draws import DrawProgram, DrawProof, Prices, knot_weights, past_of, shocks
from cirl_marl.optimum.solver import Basis

KNOTS = 3
"""Times between which prices are linear."""
CUTS = 30
"""Most rounds of cutting planes, each of which solves every draw."""
RIDGE = 1e-3
"""Penalty on the coefficients of the regression, relative to the variance of what they multiply."""
SHOCK_RIDGE = 0.3
"""The same for what shocks add to draws, of which there are few."""
ROUNDING = 1e-9
"""Relative deviation from the mean up to which something is taken not to have differed between the draws."""
WORTHWHILE = 0.1
"""Share of the fall that the cuts promise, at which a step is taken."""
FIRST_RADIUS = 0.5
"""Half of the first box, in prices on services relative to the objective."""
STOCK_WIDTH = 0.4
"""The box of prices on stocks beside that, in parts of what a stock is worth per deviation of what is new."""
SHORT, OUT_OF_REACH = 1e-3, 20.0
"""How far a service lacks, at which price relative to the objective, that no policy reaches."""
LEAST_FALL = 1e-4
"""Relative fall that is promised below which no more cuts are made."""


@positional_record
class PriceTrial:
    """What prices prove of some draws."""

    prices: Prices
    proofs: tuple[DrawProof, ...]

    @property
    def values(self) -> Floats:
        """Of each draw, shape (draws,)."""
        return np.array([proof.value for proof in self.proofs])


class Sample:
    """Programs of draws, solved again and again under other prices."""

    def __init__(self, programs: Sequence[DrawProgram]) -> None:
        """Take them."""
        self.programs = tuple(programs)
        self._bases: list[Basis | None] = [None] * len(programs)

    def __call__(self, prices: Prices) -> PriceTrial:
        """Solve all of them, each from where it was solved last, the first time from where the one before it was."""
        proofs, basis = [], None
        for i, program in enumerate(self.programs):
            proof = program.prove(program.with_prices(prices), self._bases[i] or basis)
            self._bases[i] = basis = proof.basis or self._bases[i]
            proofs.append(proof)
        return PriceTrial(prices, tuple(proofs))

    def reference(self, trial: PriceTrial) -> tuple[Floats, Floats]:
        """Return what is to be expected of stocks under the plans of a trial: ``reference`` and ``response``."""
        stocks = np.array([program.stocks(plan) for program, plan, _ in self._optima(trial)])
        past = np.array([past_of(program.draw.features) for program in self.programs])
        response = _regression(_deviations(past).reshape(-1, past.shape[2]), stocks - stocks.mean(axis=0))
        return stocks.mean(axis=0) - past.mean(axis=0) @ response, response

    def levels(self, trial: PriceTrial) -> Floats:
        """Return the levels of each draw, those of budgets included, shape (draws, services + budgets)."""
        return np.array([program.levels(plan) for program, plan, _ in self._optima(trial)])

    def slopes(self, trial: PriceTrial) -> tuple[Floats, Floats]:
        """Return subgradients of ``values``: by θ, (draws, knots, stores, functions), and by μ, as ``levels``."""
        prices, by_stock = trial.prices, []
        for program, plan, _ in self._optima(trial):
            apart = program.stocks(plan) - prices.expected_stocks(program.draw.features)
            new, knots = program.draw.new, knot_weights(len(apart), len(prices.stock))
            by_stock.append(-np.einsum("tk,tn,tf->knf", knots, apart, new))
        return np.array(by_stock), self.levels(trial) - prices.demand

    def regression(self, trial: PriceTrial) -> tuple[Floats, Floats]:
        """Return θ such that Σ_f θ_tf φ_f(s_t) is what stocks are worth, as near as it can be, by least squares.

        Returns:
            θ, and its scale: what a stock is worth, root mean square, per deviation of φ; shapes (knots, stores,
            functions). A stock whose worth never changes where the future is known may well deserve a price.
        """
        worth = np.array([program.stock_values(certificate) for program, _, certificate in self._optima(trial)])
        features = np.array([program.draw.features[1:] for program in self.programs])
        around = _deviations(features.reshape(1, -1, features.shape[2]), axis=1)
        size, deviation = np.sqrt((worth**2).mean(axis=(0, 1))), np.sqrt((around**2).mean(axis=(0, 1)))
        scales = np.divide(size[:, None], deviation, out=np.zeros((len(size), len(deviation))), where=deviation > 0)
        worth, features = worth - worth.mean(axis=0), _deviations(features)
        knots = knot_weights(worth.shape[1], len(trial.prices.stock))
        shape = len(trial.prices.stock), features.shape[2]
        table = np.einsum("itf,tk->itkf", features, knots).reshape(-1, shape[0] * shape[1])
        theta = np.moveaxis(_regression(table, worth).reshape(*shape, -1), 1, 2)
        return theta, np.broadcast_to(scales, theta.shape)

    def _optima(self, trial: PriceTrial) -> list[tuple[DrawProgram, Floats, Certificate]]:
        solutions = []
        for program, proof in zip(self.programs, trial.proofs, strict=True):
            if proof.plan is None:
                name = program.draw.network.name
                raise CirlError(
                    f"network '{name}': HiGHS fails in a draw to which prices are fitted; take another seed"
                )
            solutions.append((program, proof.plan, proof.certificate))
        return solutions


def fit_prices(
    programs: Sequence[DrawProgram],
    demand: Floats,
    scale: float,
    *,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[Prices, Prices]:
    """Return prices on services alone, for who knows the future, and on stocks and services for who does not.

    Args:
        programs: of the draws; every other one chooses among what the rest suggests.
        demand: expected level demanded of each service, shape (services,); empty if nothing is demanded. Budgets are
            those of the programs.
        scale: size of the objective, from which prices on services start.
        progress: called with the share that is done.

    Raises:
        CirlError: if not even who knows the future reaches the demanded levels, or keeps the budgets, in these draws.
    """
    first, aims = programs[0].draw, programs[0].aims
    steps, functions = first.new.shape
    stores, services = len(first.network.stores), len(first.network.services)
    free = Prices(
        stock=np.zeros((KNOTS, stores, functions)),
        reference=np.zeros((steps, stores)),
        response=np.zeros((past_of(first.features).shape[1], stores)),
        service=np.zeros(services + len(aims.budgets)),
        demand=np.append(demand if len(demand) else np.zeros(services), -aims.limits / aims.sizes),
        shocks=np.zeros((2, functions)),
    )
    sample, judges = Sample(programs[::2]), Sample(programs[1::2])
    trial = sample(free)
    if len(demand) or aims.budgets:
        trial = improve(sample, [trial], np.zeros_like(free.stock), scale, len(demand) > 0)[-1]
        _check_reach(sample, trial, scale)
    progress(0.3)
    clairvoyant, trials = trial.prices, [trial]
    if functions and steps:
        # while nothing is charged, the stocks from which it counts do not matter
        reference, response = sample.reference(trial)
        trial = replace(trial, prices=replace(clairvoyant, reference=reference, response=response))
        theta, scales = sample.regression(trial)
        trials = [trial, sample(replace(trial.prices, stock=theta))]
        trials.append(improve(sample, trials, scales, scale, len(demand) > 0, progress)[-1])
    verdicts = [judges(trial.prices) for trial in trials]
    progress(1.0)
    best = int(np.argmin([verdict.values.mean() for verdict in verdicts]))
    draws = [program.draw.new for program in (*sample.programs, *judges.programs)]
    return (
        replace(clairvoyant, shocks=_worth_of_shocks(draws, trials[0], verdicts[0])),
        replace(trials[best].prices, shocks=_worth_of_shocks(draws, trials[best], verdicts[best])),
    )


def _worth_of_shocks(draws: Sequence[Floats], *trials: PriceTrial) -> Floats:
    """Return κ, by regression of what is proved of draws on what is new in them."""
    table = np.array([shocks(new).ravel() for new in draws])
    values = np.concatenate([trial.values for trial in trials])
    return _regression(table, values - values.mean(), SHOCK_RIDGE).reshape(2, -1)


def _check_reach(sample: Sample, trial: PriceTrial, scale: float) -> None:
    """Refuse levels that are missed, and budgets that are exceeded, at any price."""
    prices, levels, first = trial.prices, sample.levels(trial).mean(axis=0), sample.programs[0]
    network, aims, count = first.draw.network, first.aims, len(sample.programs)
    services = len(network.services)
    for s in np.flatnonzero((levels < prices.demand - SHORT) & (prices.service > OUT_OF_REACH * scale)).tolist():
        if s < services:
            text = f"reaches an expected level of {prices.demand[s]:g} of '{network.services[s].id}' (at most"
            beside = "".join(f", expected {budget}" for budget, _ in budget_texts(network, aims))
            raise CirlError(f"no policy {text} {levels[s]:.6g} in {count} draws{beside})")
        budget, amount = aims.budgets[s - services], -levels[s] * aims.sizes[s - services]
        note = f"(at the highest price that was tried {count} draws come to {amount:.6g})"
        raise CirlError(f"no policy keeps an expected {budget.text(network)} {note}")


def improve(
    sample: Sample,
    trials: Sequence[PriceTrial],
    stock_scales: Floats,
    scale: float,
    has_demand: bool = True,
    progress: Callable[[float], None] = lambda share: None,
) -> list[PriceTrial]:
    """Lower the mean of what is proved by cutting planes in a box around the best prices so far.

    Args:
        sample: the draws.
        trials: where to begin.
        stock_scales: of θ, shape (knots, stores, functions); 0 of what is to stay as it is.
        scale: of the objective.
        has_demand: whether prices on services may change.
        progress: called with the share that is done, from 0.3 on.

    Returns:
        Trials each of which was better than all before, the best last.
    """
    free, constraints = stock_scales > 0, len(trials[0].prices.service)
    count, services = int(free.sum()), len(sample.programs[0].draw.network.services)
    units = np.concatenate([STOCK_WIDTH * stock_scales[free], np.full(constraints, scale)])
    width = np.ones(count + constraints)
    width[count : count + services] = 1.0 if has_demand else 0.0
    cuts, places = _Cuts(), []
    for trial in trials:
        places.append(np.concatenate([trial.prices.stock[free], trial.prices.service]) / units)
        cuts.add(sample, trial, free, units, places[-1])
    first = int(np.argmin([trial.values.mean() for trial in trials]))
    best, best_at = trials[first], places[first]
    improvements, radius = [best], FIRST_RADIUS
    for k in range(CUTS):
        progress(0.3 + 0.6 * k / CUTS)
        box = np.stack([best_at - radius * width, best_at + radius * width])
        box[0, count:] = np.maximum(box[0, count:], 0.0)
        at, estimate = cuts.lowest(box)
        fall = best.values.mean() - estimate
        if fall <= LEAST_FALL * abs(estimate):
            break
        stock = best.prices.stock.copy()
        stock[free] = (at * units)[:count]
        trial = sample(replace(best.prices, stock=stock, service=(at * units)[count:]))
        cuts.add(sample, trial, free, units, at)
        decrease = best.values.mean() - trial.values.mean()
        radius *= 2.0 if decrease > 0.5 * fall else 1.0 if decrease > WORTHWHILE * fall else 0.5
        if decrease > 0:
            best, best_at = trial, at
            improvements.append(trial)
    return improvements


class _Cuts:
    """For each draw the planes below what is proved of it, which is convex in the prices."""

    def __init__(self) -> None:
        self._slopes: list[Floats] = []
        self._offsets: list[Floats] = []

    def add(self, sample: Sample, trial: PriceTrial, free: NDArray[np.bool_], units: Floats, at: Floats) -> None:
        """Add the planes that touch it at a trial."""
        by_stock, by_service = sample.slopes(trial)
        slopes = np.concatenate([by_stock[:, free], by_service], axis=1) * units
        self._slopes.append(slopes)
        self._offsets.append(trial.values - slopes @ at)

    def lowest(self, box: Floats) -> tuple[Floats, float]:
        """Return where in a box, shape (2, size), the mean of the highest plane of each draw is least, and this."""
        slopes, offsets = np.concatenate(self._slopes), np.concatenate(self._offsets)
        draws, size = len(self._offsets[0]), slopes.shape[1]
        # minimise the mean of η_i subject to slope·y + offset ≤ η_i
        above = -sparse.vstack([sparse.eye_array(draws)] * len(self._offsets))
        solution = optimize.linprog(
            np.concatenate([np.zeros(size), np.full(draws, 1.0 / draws)]),
            A_ub=sparse.hstack([sparse.csr_array(slopes), above], format="csr"),
            b_ub=-offsets,
            bounds=[*box.T.tolist(), *[(None, None)] * draws],
        )
        if solution.x is None:
            raise CirlError(f"HiGHS did not solve the program of the prices: {solution.message}")
        return solution.x[:size], float(solution.fun)


def _deviations(samples: Floats, axis: int = 0) -> Floats:
    """Return samples, shape (draws, steps, functions), less their mean; what differs by rounding alone is 0."""
    apart: Floats = samples - samples.mean(axis=axis, keepdims=True)
    apart[..., np.abs(apart).max(axis=(0, 1)) <= ROUNDING * np.abs(samples).max(axis=(0, 1))] = 0.0
    return apart


def _regression(table: Floats, target: Floats, ridge: float = RIDGE) -> Floats:
    """Return the coefficients of the columns of a table by ridge regression, (columns, …); of those that are 0 none."""
    size = np.sqrt((table**2).mean(axis=0))
    table = np.divide(table, size, out=np.zeros_like(table), where=size > 0)
    normal = table.T @ table + ridge * len(table) * np.eye(table.shape[1])
    solution = np.linalg.solve(normal, table.T @ target.reshape(len(table), -1))
    coefficients: Floats = np.divide(solution, size[:, None], out=np.zeros_like(solution), where=size[:, None] > 0)
    return coefficients
