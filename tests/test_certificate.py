"""Certificates that do not prove what they seem to: multipliers of the wrong sign, and no numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from cirl_marl import CirlError, Network, load_network
from cirl_marl.optimum import Certificate, bound, simulate_plan
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.certificate import verify
from cirl_marl.optimum.options import starting_stocks
from cirl_marl.optimum.program import Program, Programs
from cirl_marl.optimum.solver import solve
from cirl_marl.optimum.vintages import Lifetimes


@pytest.mark.parametrize(("name", "horizon"), [("copper_net", 6), ("carbo_net", 6)])
def test_multipliers_of_an_over_constrained_program_prove_nothing_false(name: str, horizon: int) -> None:
    """Multipliers of the wrong sign are worth nothing, though they come from an optimum.

    It is that of the program with G v ≥ G v' besides, v' being the worst plan. It lies far below what can be achieved,
    and its multipliers would prove it, if the certificate trusted their sign.
    """
    network = load_network(name).with_options(episode={"horizon": horizon})
    problem = Programs(Admissible.of(network), 1, None).program(starting_stocks(Lifetimes(network, ()), None))
    multipliers = _over_constrained(problem)
    wrong = float(multipliers.under.max())
    best = bound(network, degree=1)
    reached = float(simulate_plan(best).episode_circularity[0])
    scale = abs(reached)
    trusting = _if_signs_were_trusted(problem, multipliers)
    assert wrong > 0 and trusting < reached - 0.1 * scale, "the multipliers are no temptation"
    proof = verify(problem, multipliers, best.solution)
    assert proof.bound >= reached - 1e-9 * scale
    assert proof.bound >= best.verify().objective - 1e-6 * scale
    assert proof.infeasibility == wrong


def test_every_wrong_sign_is_worth_nothing() -> None:
    """A positive multiplier of an inequality proves exactly what 0 in its place does."""
    network: Network = load_network("carbo_net").with_options(episode={"horizon": 3})
    best = bound(network, degree=1)
    under = best.certificate.under
    zeroed = replace(best.certificate, under=np.where(under < 0, under, 0.0))
    positive = replace(best.certificate, under=np.where(under < 0, under, 1.0 + np.arange(len(under))))
    assert replace(best, certificate=positive).verify().bound == replace(best, certificate=zeroed).verify().bound


def _over_constrained(problem: Program) -> Certificate:
    """Return the multipliers of the program with G v ≥ G v' besides, v' being the worst plan.

    Those of −G v ≤ −G v' are multipliers of G v with the opposite sign; as g ≥ G v', they prove no less with g.
    """
    worst = solve(replace(problem, cost=-problem.cost)).plan
    tight = replace(
        problem,
        under=sparse.vstack([problem.under, -problem.under], format="csr"),
        under_to=np.concatenate([problem.under_to, np.maximum(-problem.under @ worst, -problem.under_to)]),
    )
    found, rows = solve(tight).certificate, len(problem.under_to)
    return Certificate(equal=found.equal, under=found.under[:rows] - found.under[rows:])


def _if_signs_were_trusted(problem: Program, multipliers: Certificate) -> float:
    y, mu = multipliers.equal, multipliers.under
    reduced = problem.cost - problem.equal.T @ y - problem.under.T @ mu
    charged = np.minimum(reduced * problem.low, reduced * problem.high)
    return problem.constant - float(problem.equal_to @ y + problem.under_to @ mu + charged.sum())


@pytest.mark.parametrize(("rows", "row"), [("equal", 3), ("under", 5)])
def test_a_multiplier_that_is_no_number_is_refused(rows: str, row: int) -> None:
    """NaN would make the bound NaN, which is not exceeded by any number either; the error names its row."""
    best = bound("carbo_net", degree=1, horizon=2)
    multipliers = getattr(best.certificate, rows).copy()
    multipliers[row] = np.nan
    broken = replace(best, certificate=replace(best.certificate, **{rows: multipliers}))
    with pytest.raises(CirlError, match=rf"row {row}\b"):
        broken.verify()


@pytest.mark.parametrize("size", [1e100, 1e200, 1e306, 1.7e308])
def test_multipliers_whose_sums_overflow_prove_nothing(size: float) -> None:
    """One of them, of either kind and sign, or all; the bound is a number that no episode exceeds, or infinite."""
    best = bound("carbo_net", degree=1, horizon=2)
    equal, under, reached = best.certificate.equal, best.certificate.under, best.verify().objective
    proofs = [
        replace(best, certificate=replace(best.certificate, equal=np.where(place == changed, sign * size, equal)))
        for place in [np.arange(len(equal))]
        for changed in (0, 7, place)
        for sign in (1.0, -1.0)
    ]
    first = np.arange(len(under)) < 3
    proofs.append(replace(best, certificate=replace(best.certificate, under=np.where(first, -size, under))))
    bounds = np.array([proof.verify().bound for proof in proofs])
    assert (bounds >= reached - 1e-9 * abs(reached)).all()
    assert size < 1.7e308 or np.isinf(bounds).any()
