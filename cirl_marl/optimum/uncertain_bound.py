"""An upper bound on what policies reach on average that do not know the future, certified draw by draw."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from cirl_marl.controllers.rollout import SEED_SPACING, first_seed
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import frozen_record
from cirl_marl.optimum.aims import NO_AIMS, Aims, budget_texts
from cirl_marl.optimum.certificate import Certificate, verify
from cirl_marl.optimum.draw_proofs import Sampling, draw, prove_draws
from cirl_marl.optimum.draws import DrawProgram, Prices
from cirl_marl.optimum.options import levels_text, starting_stocks
from cirl_marl.optimum.price_fit import fit_prices
from cirl_marl.optimum.solver import LARGE_PROGRAM
from cirl_marl.optimum.vintages import Lifetimes

CONFIDENCE = 0.95
NEAR_ZERO = 0.05
"""Share of the mass that λ counts, below which a bound is no measure of gaps."""
NOTHING = 1e-6
"""Share of the circularity scale up to which a bound is rounding of the solver."""


@frozen_record
class UncertainBound:
    """What the mean of λ̄ does not exceed under any policy that does not foresee, from draws with a certificate each.

    Every policy that delivers the demanded services and keeps the budgets on average has E[λ̄] ≤ E[values], and every
    other one E[λ̄ + Σ_s μ_s (level_s − demand_s) + Σ_b μ_b (budget_b − amount_b)] ≤ E[values].
    """

    network: Annotated[Network, "the network, under its scenario and horizon"]
    agents: Annotated[tuple[str, ...], "who acts; the others are neutral"]
    initial: Annotated[Floats | None, "stocks from which all draws start, by stage; None if starts are drawn as well"]
    degree: Annotated[int, "degree of the test polynomials"]
    sampling: Annotated[Sampling, "how it was drawn"]
    min_service: Annotated[Floats | None, "expected mean level demanded of each service, shape (services,)"]
    prices: Annotated[Prices, "on what is new about stocks, and on services; fixed before any of the draws was made"]
    informed_prices: Annotated[Prices, "on services alone, of who knows the future"]
    values: Annotated[Floats, "what is proved of each draw, penalty included, shape (draws,), mass"]
    informed_values: Annotated[Floats, "what is proved of who knows the future, likewise"]
    luck: Annotated[Floats, "what is new in each draw by itself, of mean 0, taken off ``values``, shape (draws,), mass"]
    informed_luck: Annotated[Floats, "likewise, of ``informed_values``"]
    gross_mass: Annotated[Floats, "gross mass that λ counts in the plan of each draw, Δ·Σ|σ_k|·f̄_k, NaN without a plan"]
    certificates: Annotated[tuple[Certificate, ...], "multipliers of the program of each draw"]
    aims: Annotated[Aims, "budgets of expected amounts on accounts"] = NO_AIMS

    @property
    def value(self) -> float:
        """The bound, an estimate: the mean of ``values`` less ``luck``, mass."""
        return float((self.values - self.luck).mean())

    @property
    def upper(self) -> float:
        """Upper end of the one-sided 95 % interval (Student) of the bound, mass."""
        return self.value + self.half_width

    @property
    def half_width(self) -> float:
        """How far ``upper`` lies above ``value``, mass."""
        count = len(self.values)
        return float(stats.t.ppf(CONFIDENCE, count - 1) * (self.values - self.luck).std(ddof=1) / np.sqrt(count))

    @property
    def perfect_information(self) -> float:
        """The same mean for who knows the future, v = 0, mass."""
        return float((self.informed_values - self.informed_luck).mean())

    @property
    def failures(self) -> int:
        """Draws whose program the solver did not solve; they count with what other multipliers prove."""
        return int(np.isnan(self.gross_mass).sum())

    @property
    def scale(self) -> float:
        """By what gaps are divided: |bound|, or the gross mass that λ counts where the bound is below 5 % of it.

        Where that is nothing but the tolerance of the solver, it is the circularity scale.
        """
        gross_mass = float(np.nanmean(self.gross_mass)) if self.failures < len(self.gross_mass) else 0.0
        scale = abs(self.value) if abs(self.value) >= NEAR_ZERO * gross_mass else gross_mass
        circularity_scale = self.network.objective.circularity_scale
        return scale if scale > NOTHING * circularity_scale else circularity_scale

    @property
    def draws_numbers(self) -> bool:
        """Whether uncertain numbers are drawn, too."""
        return self.sampling.numbers and bool(self.network.uncertain)

    @property
    def hidden_numbers(self) -> tuple[str, ...]:
        """Numbers drawn once per episode, which the bound knows from the start and a policy does not."""
        return tuple(self.network.uncertain) if self.draws_numbers else ()

    @property
    def budget_prices(self) -> dict[str, float]:
        """What the bound falls by with one unit less of each expected amount, to first order, mass per unit."""
        multipliers = self.prices.service[len(self.network.services) :] / self.aims.sizes
        return dict(zip((budget.name for budget in self.aims.budgets), multipliers.tolist(), strict=True))

    def gaps(
        self,
        circularity: ArrayLike,
        levels: ArrayLike,
        bookings: ArrayLike | None = None,
        *,
        with_foresight: bool = False,
    ) -> Floats:
        """Return (bound − λ̄ − Σ_s μ_s (level_s − demand_s))/scale of each draw under a policy; its gap is their mean.

        Args:
            circularity: λ̄ of the episodes, shape (draws,), or (any,) of the first draws.
            levels: mean level of each service, shape (draws, services).
            bookings: what is booked of each budget (``aims.bookings``), (draws, budgets); None where there are none.
            with_foresight: whether it is held against who knows the future instead.

        Raises:
            CirlError: for other shapes.
        """
        prices, values = (self.informed_prices, self.informed_values) if with_foresight else (self.prices, self.values)
        count, services = np.size(circularity), len(self.network.services)
        if np.shape(circularity) != (count,) or count > len(values) or np.shape(levels) != (count, services):
            raise CirlError(
                f"gaps: circularity of shape {np.shape(circularity)} and levels of shape {np.shape(levels)}; expected "
                f"(draws,), at most {len(values)} draws, and (draws, {services})"
            )
        amounts = np.zeros((count, 0)) if bookings is None else np.asarray(bookings, dtype=float)
        if amounts.shape != (count, len(self.aims.budgets)):
            expected = f"expected {(count, len(self.aims.budgets))}, what is booked of each budget"
            raise CirlError(f"gaps: bookings of shape {amounts.shape}; {expected}")
        constraints = np.concatenate([np.asarray(levels, dtype=float), -amounts / self.aims.sizes], axis=1)
        merit = np.asarray(circularity, dtype=float) + prices.service_value(constraints)
        return np.asarray((values[: len(merit)] - merit) / self.scale)

    def closure(self, foresight_gap: float) -> float:
        """Return the share of a policy's mean gap to who knows the future that the prices close; NaN if it is 0."""
        closed = (self.perfect_information - self.value) / self.scale
        return closed / foresight_gap if foresight_gap else math.nan

    def as_dict(self) -> dict[str, Any]:
        """Return its figures, ready for JSON."""
        ids = [service.id for service in self.network.services]
        prices = {"budget_prices": self.budget_prices} if self.aims.budgets else {}
        names = ("value", "upper", "perfect_information", "scale", "failures")
        return {name: getattr(self, name) for name in names} | {
            "draws": len(self.values),
            "fit_draws": self.sampling.fit_draws,
            "seed": self.sampling.seed,
            "draws_numbers": self.draws_numbers,
            "service_prices": dict(zip(ids, self.prices.service[: len(ids)].tolist(), strict=True)),
            **prices,
        }

    def verify(self) -> float:
        """Draw everything again, compute what the multipliers prove of each draw, and return the mean, mass."""
        first, numbers, proofs = first_seed(self.sampling.seed), self.sampling.numbers, []
        draws = draw(self.network, self.agents, self.initial, numbers, first, len(self.values))
        for future, certificate in zip(draws, self.certificates, strict=True):
            program = DrawProgram(future, self.agents or None, self.degree, aims=self.aims)
            problem = program.with_prices(self.prices)
            proved = verify(problem, certificate, np.zeros(len(problem.cost))).bound
            proofs.append(proved - self.prices.luck(future.new))
        return float(np.mean(proofs))

    def __str__(self) -> str:
        """Say what is proved, in one line."""
        mass, demand = self.network.mass_unit, ""
        if self.min_service is not None and self.network.services:
            demand = f", expected service level at least {levels_text(self.network, self.min_service)}"
        demand += "".join(f", expected {text}" for text, _ in budget_texts(self.network, self.aims))
        hidden = (
            f"; it knows from the start what a policy does not: {', '.join(self.hidden_numbers)}"
            if self.hidden_numbers
            else ""
        )
        failures = f"; {self.failures} draws by multipliers of others" if self.failures else ""
        return (
            f"bound of {self.network.name} for who does not foresee: mean λ̄ ≤ {self.value:.6g} {mass}{demand} (at most "
            f"{self.upper:.6g} with 95 % confidence, {len(self.values)} draws; with perfect information "
            f"{self.perfect_information:.6g}){hidden}{failures}"
        )


def uncertain_bound(
    network: Network,
    agents: Sequence[str] | None,
    initial: Mapping[str, float] | ArrayLike | None,
    min_service: Floats | None,
    degree: int,
    sampling: Sampling,
    aims: Aims = NO_AIMS,
    progress: Callable[[float], None] = lambda share: None,
) -> UncertainBound:
    """Bound the mean of λ̄ of policies that do not foresee; see ``bound``, which checks the arguments.

    Raises:
        CirlError: if nothing is uncertain, the program of a draw is too large, or services or budgets are out of reach.
        NoCertificate: for a network whose flows are not linear laws.
    """
    sampling = sampling.validate()
    if not network.disturbed and not (network.uncertain and sampling.numbers):
        raise CirlError(f"network '{network.name}': nothing disturbs it and no number is drawn; leave out uncertain")
    sampling.check_paths(network)
    first, actors = first_seed(sampling.seed), MultiAgentVectorEnv(network, num_envs=1, agents=agents).agents
    start = None if initial is None else starting_stocks(Lifetimes(network, actors), initial)
    futures = draw(network, agents, start, sampling.numbers, first + SEED_SPACING // 2, sampling.fit_draws)
    programs = []
    for future in futures:
        programs.append(DrawProgram(future, agents, degree, aims=aims))
        check_size(programs[-1])
        progress(0.1 * len(programs) / len(futures))
    demand = np.zeros(0) if min_service is None else min_service
    scale = network.objective.circularity_scale
    clairvoyant, prices = fit_prices(programs, demand, scale, progress=lambda share: progress(0.1 + 0.2 * share))
    proofs = prove_draws(
        network, actors, start, degree, sampling, (clairvoyant, prices), aims, lambda share: progress(0.3 + 0.7 * share)
    )
    return UncertainBound(
        network=network,
        agents=actors,
        initial=start,
        degree=degree,
        sampling=sampling,
        min_service=min_service,
        prices=prices,
        informed_prices=clairvoyant,
        values=proofs.values[:, 1],
        informed_values=proofs.values[:, 0],
        luck=proofs.luck[:, 1],
        informed_luck=proofs.luck[:, 0],
        gross_mass=proofs.gross_mass,
        certificates=proofs.certificates,
        aims=aims,
    )


def check_size(program: DrawProgram) -> None:
    """Refuse a program that is too large to be solved for every draw.

    Raises:
        CirlError: with its size.
    """
    count, name = len(program.problem.cost), program.draw.network.name
    if count > LARGE_PROGRAM:
        raise CirlError(
            f"network '{name}': the program of a draw has {count:,} variables, more than {LARGE_PROGRAM:,}; take a "
            "shorter horizon, a longer control interval or a lower degree"
        )
