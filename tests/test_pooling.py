"""Pooling problems of the literature, whose optima are known: contents of products that pools and splits mix."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import pytest

from cirl_marl import MPC, Account, Arc, Control, ControlKind, Episode, Law, Network, Node, Service, Substance
from cirl_marl.controllers.rollout import episode_start
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum import bound, improve, improve_plan, linearised, simulate_plan, solver
from cirl_marl.optimum.linearised import StepProgram


@positional_record
class Source:
    """What can be bought."""

    price: float
    contents: Annotated[dict[str, float], "percent of each substance"]
    most: float = 600.0


@positional_record
class Product:
    """What can be sold."""

    price: float
    limits: Annotated[dict[str, float], "highest percent of each substance"]
    most: float


@positional_record
class Pooling:
    """A problem: sources fill pools, which together with a source that goes past them make products."""

    sources: dict[str, Source]
    pools: Annotated[dict[str, tuple[str, ...]], "what fills each"]
    past: Annotated[str, "source that goes to products without a pool"]
    products: dict[str, Product]
    optimum: Annotated[float, "known profit"]
    envelope: Annotated[float, "profit that McCormick's envelopes allow"]

    def network(self) -> Network:
        """Return the network of one interval; its costs, and what is made of each product, are accounts."""
        return Network(
            name="pooling",
            nodes=tuple(self._nodes()),
            arcs=tuple(self._arcs()),
            services=tuple(self._services()),
            accounts=(
                Account(id="cost", unit="EUR_2023"),
                *(Account(id=product, unit="t") for product in self.products),
            ),
            substances=tuple(Substance(id=name, scale=0.02) for name in self.sources[self.past].contents),
            mass_unit="t",
            time_unit="year",
            episode=Episode(control_interval=1.0, horizon=1),
        )

    def _nodes(self) -> list[Node]:
        sources = [
            Node(id=name, initial=(1e4, 1e4), content={part: share / 100 for part, share in source.contents.items()})
            for name, source in self.sources.items()
        ]
        products = [Node(id=product, initial=(0.0, 0.0)) for product in self.products]
        blends = [f"blend_{product}" for product in self.products]
        return [*sources, *products, *(Node(id=name, stores=False) for name in (*self.pools, *blends))]

    def _arcs(self) -> list[Arc]:
        ways = [(source, pool) for pool, sources in self.pools.items() for source in sources]
        ways += [(self.past, f"blend_{product}") for product in self.products]
        arcs = [
            Arc(
                id=f"{source}_to_{to}",
                donor=source,
                recipient=to,
                law=Law.CONTROLLED,
                control=Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=self.sources[source].most),
                accounts={"cost": self.sources[source].price},
            )
            for source, to in ways
        ]
        share = Control(kind=ControlKind.SHARE, low=0.0, neutral=1.0 / len(self.products), high=1.0)
        *chosen, rest = self.products
        for pool in self.pools:
            arcs += [
                Arc(id=f"{pool}_{product}", donor=pool, recipient=f"blend_{product}", law=Law.SHARE, control=share)
                for product in chosen
            ]
            arcs.append(Arc(id=f"{pool}_{rest}", donor=pool, recipient=f"blend_{rest}", law=Law.SHARE))
        for name, product in self.products.items():
            accounts = {"cost": -product.price, name: 1.0}
            arcs.append(Arc(id=f"sold_{name}", donor=f"blend_{name}", recipient=name, law=Law.SHARE, accounts=accounts))
        return arcs

    def _services(self) -> list[Service]:
        return [
            Service(
                id=f"{part}_{name}",
                provider=f"sold_{name}",
                quantity="flow",
                substance=part,
                low=0.0,
                high=percent / 100,
            )
            for name, product in self.products.items()
            for part, percent in product.limits.items()
        ]


def haverly(
    most_x: float, price_b: float, optimum: float, envelope: float, most: float = 600.0, **further: Source
) -> Pooling:
    """Return a problem of Haverly (1978); that of Ben-Tal et al. (1994) has one source more."""
    sulfur = [{"sulfur": percent} for percent in (3.0, 1.0, 2.0)]
    prices = {"a": 6.0, "b": price_b, "c": 10.0}
    sources = {name: Source(price, part, most) for (name, price), part in zip(prices.items(), sulfur, strict=True)}
    sources |= further
    products = {"x": Product(9.0, {"sulfur": 2.5}, most_x), "y": Product(15.0, {"sulfur": 1.5}, 200.0)}
    return Pooling(sources, {"pool": ("a", "b", *further)}, "c", products, optimum, envelope)


def ben_tal_5() -> Pooling:
    """Return the fifth problem of Ben-Tal et al. (1994): three pools of the same sources, two qualities."""
    kinds = [(6.0, 3.0, 1.0), (16.0, 1.0, 3.0), (15.0, 1.2, 5.0), (12.0, 1.5, 2.5)]
    pools = {f"pool_{k}": tuple(f"s{k}{i}" for i in range(len(kinds))) for k in range(3)}
    sources = {
        name: Source(price, {"q": q, "r": r})
        for names in pools.values()
        for name, (price, q, r) in zip(names, kinds, strict=True)
    }
    limits = [(18.0, 2.5, 2.0, 100.0), (15.0, 1.5, 2.5, 200.0), (19.0, 2.0, 2.6, 100.0), (16.0, 2.0, 2.0, 100.0)]
    limits.append((14.0, 2.0, 2.0, 100.0))
    products = {f"p{i}": Product(price, {"q": q, "r": r}, most) for i, (price, q, r, most) in enumerate(limits)}
    sources["past"] = Source(10.0, {"q": 2.0, "r": 2.5}, 200.0)
    return Pooling(sources, pools, "past", products, 3500.0, 3500.0)


PROBLEMS = {
    "Haverly 1": haverly(100.0, 16.0, 400.0, 500.0),
    "Haverly 2": haverly(600.0, 16.0, 600.0, 1000.0),
    "Haverly 2, larger sources": haverly(600.0, 16.0, 600.0, 1000.0, most=800.0),
    "Haverly 3": haverly(100.0, 13.0, 750.0, 875.0),
    "Ben-Tal 4": haverly(100.0, 16.0, 450.0, 550.0, d=Source(15.0, {"sulfur": 1.0}, 50.0)),
    "Ben-Tal 5": ben_tal_5(),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_plans_solve_pooling_problems(name: str) -> None:
    """The plan makes the known profit, the bound is what envelopes of products allow."""
    problem = PROBLEMS[name]
    most = np.array([product.most for product in problem.products.values()])
    budgets = dict(zip(problem.products, most.tolist(), strict=True))
    solution = bound(problem.network(), aim="cost", at_most=budgets, min_service=1.0)
    assert solution.objective == pytest.approx(problem.envelope, rel=1e-5)
    run = simulate_plan(improve_plan(solution))
    assert -run.accounts[0, 0] == pytest.approx(problem.optimum, rel=1e-3)
    np.testing.assert_allclose(run.episode_levels[0], 1.0, atol=2e-4)
    assert (run.accounts[0, 1:] <= most * (1 + 1e-5)).all()


@pytest.mark.slow
def test_mpc_is_no_worse_than_the_plan_that_it_could_follow() -> None:
    """Also beside budgets, where the optimum of the program alone leads to 400 of 600."""
    problem = PROBLEMS["Haverly 2"]
    budgets = {name: product.most for name, product in problem.products.items()}
    env = MultiAgentVectorEnv(problem.network(), num_envs=1)
    run = episode_start(env).play(env, MPC(aim="cost", at_most=budgets, min_service=1.0))
    assert -run.accounts[0, 0] == pytest.approx(problem.optimum, rel=1e-3)
    assert run.least_service[0] >= 1.0 - 2e-4
    assert (run.accounts[0, 1:] <= np.array([*budgets.values()]) * (1 + 1e-5)).all()


@pytest.mark.slow
def test_a_leap_that_fails_is_not_made_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is too impure goes at once or not at all; then its price rises."""
    leaps, make, values = list[float](), linearised.step_program, solver.best_values
    are_leaps = list[bool]()

    def observed(*arguments: Any, **options: Any) -> StepProgram:
        are_leaps.append(options["is_leap"])
        leaps.extend(arguments[5:6] * are_leaps[-1])
        return make(*arguments, **options)

    monkeypatch.setattr(improve, "step_program", observed)
    monkeypatch.setattr(improve, "best_values", lambda *program: None if are_leaps[-1] else values(*program))
    network = PROBLEMS["Haverly 2"].network()
    improve_plan(bound(network, aim="cost", at_most={"x": 600.0, "y": 200.0}, min_service=1.0), rounds=6)
    assert len(leaps) > 1 and set(leaps) == {improve.LEAP}
