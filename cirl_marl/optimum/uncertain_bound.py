"""An upper bound on what policies reach on average that do not know the future, certified draw by draw."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from cirl_marl.controllers.rollout import SEED_SPACING, first_seed
from cirl_marl.definitions.writer import fingerprint
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.jobs import JobStatus, Tell, check_place, raise_first, run_jobs
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import frozen_record, positional_record
from cirl_marl.optimum.certificate import Certificate, verify
from cirl_marl.optimum.draws import Draw, DrawProgram, Prices, draws_of
from cirl_marl.optimum.options import levels_text, starting_stocks
from cirl_marl.optimum.price_fit import fit_prices
from cirl_marl.optimum.program import circularity_weights
from cirl_marl.optimum.solver import LARGE_PROGRAM
from cirl_marl.optimum.vintages import Lifetimes
from cirl_marl.records.files import write_atomically

FEWEST = 10
"""Draws below which no interval is given."""
CHUNK = 8
"""Draws of a job."""
CONFIDENCE = 0.95
NEAR_ZERO = 0.05
"""Share of the mass that λ counts, below which a bound is no measure of gaps."""


@frozen_record
class Sampling:
    """How many futures are drawn, and where their programs are solved."""

    draws: Annotated[
        int, "of which the bound is the mean, at least 10; as many episodes of ``compare`` draw the same"
    ] = 200
    fit_draws: Annotated[int, "further draws, to which prices are fitted, at least 4"] = 32
    seed: Annotated[int, "of the draws; different seeds share none"] = 0
    numbers: Annotated[bool, "whether the uncertain numbers of the network are drawn, too, once for each episode"] = (
        True
    )
    on: Annotated[str, "``here``, ``local``, ``slurm`` or ``ray``, see ``jobs.run_jobs``"] = "here"
    workers: Annotated[int | None, "how many work at a time; None is all that the place has"] = None
    settings: Annotated[Mapping[str, str], "of ``sbatch``, for ``slurm``"] = field(default_factory=dict)
    directory: Annotated[Path | None, "where what is done is kept, for machines that share it; None: nowhere"] = None

    def check(self) -> None:
        """Refuse what cannot be.

        Raises:
            CirlError: for too few draws, or a place that cannot be used.
        """
        for name, least in (("draws", FEWEST), ("fit_draws", 4)):
            if getattr(self, name) < least:
                raise CirlError(f"{name} {getattr(self, name)}: too few for an interval, at least {least}")
        if max(self.draws, self.fit_draws) > SEED_SPACING // 2:
            raise CirlError(f"draws and fit_draws must be at most {SEED_SPACING // 2:,}")
        check_place(self.on, self.workers, self.settings)
        if self.on == "slurm" and self.directory is None:
            raise CirlError("on 'slurm' needs a directory that all machines share")


@frozen_record
class UncertainBound:
    """What the mean of λ̄ does not exceed under any policy that does not foresee, from draws with a certificate each.

    Every policy that delivers the demanded services on average has E[λ̄] ≤ E[values], and every other one
    E[λ̄ + Σ_s μ_s (level_s − demand_s)] ≤ E[values].
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
    gross_mass: Annotated[Floats, "gross mass that λ counts in the plan of each draw, Δ·Σ|σ_k|·f̄_k, NaN without a plan"]
    certificates: Annotated[tuple[Certificate, ...], "multipliers of the program of each draw"]

    @property
    def value(self) -> float:
        """The bound, an estimate: the mean of ``values``, mass."""
        return float(self.values.mean())

    @property
    def upper(self) -> float:
        """Upper end of the one-sided 95 % interval (Student) of the bound, mass."""
        return self.value + self.half_width

    @property
    def half_width(self) -> float:
        """How far ``upper`` lies above ``value``, mass."""
        count = len(self.values)
        return float(stats.t.ppf(CONFIDENCE, count - 1) * self.values.std(ddof=1) / np.sqrt(count))

    @property
    def perfect_information(self) -> float:
        """The same mean for who knows the future, v = 0, mass."""
        return float(self.informed_values.mean())

    @property
    def failures(self) -> int:
        """Draws whose program the solver did not solve; they count with what other multipliers prove."""
        return int(np.isnan(self.gross_mass).sum())

    @property
    def scale(self) -> float:
        """By what gaps are divided: |bound|, or the gross mass that λ counts where the bound is below 5 % of it."""
        gross_mass = float(np.nanmean(self.gross_mass)) if self.failures < len(self.gross_mass) else 0.0
        return abs(self.value) if abs(self.value) >= NEAR_ZERO * gross_mass else gross_mass

    @property
    def hidden_numbers(self) -> tuple[str, ...]:
        """Numbers drawn once per episode, which the bound knows from the start and a policy does not."""
        return tuple(self.network.uncertain) if self.sampling.numbers else ()

    def gaps(self, circularity: ArrayLike, levels: ArrayLike, *, with_foresight: bool = False) -> Floats:
        """Return (bound − λ̄ − Σ_s μ_s (level_s − demand_s))/scale of each draw under a policy; its gap is their mean.

        Args:
            circularity: λ̄ of the episodes, shape (draws,), or (any,) of the first draws.
            levels: mean level of each service, shape (draws, services).
            with_foresight: whether it is held against who knows the future instead.
        """
        prices, values = (self.informed_prices, self.informed_values) if with_foresight else (self.prices, self.values)
        merit = np.asarray(circularity, dtype=float) + prices.service_value(np.asarray(levels, dtype=float))
        return np.asarray((values[: len(merit)] - merit) / self.scale)

    def closure(self, merit: float) -> float:
        """Return the share of the distance between perfect information and a policy that the penalty closes.

        ``merit`` is the policy's mean of λ̄ + Σ_s μ_s (level_s − demand_s), with the prices of who knows the future.
        """
        return (self.perfect_information - self.value) / (self.perfect_information - merit)

    def verify(self) -> float:
        """Draw everything again, compute what the multipliers prove of each draw, and return the mean, mass."""
        first, numbers, proofs = first_seed(self.sampling.seed), self.sampling.numbers, []
        draws = draw(self.network, self.agents, self.initial, numbers, first, len(self.values))
        for future, certificate in zip(draws, self.certificates, strict=True):
            problem = DrawProgram(future, self.agents or None, self.degree).with_prices(self.prices)
            proofs.append(verify(problem, certificate, np.zeros(len(problem.cost))).bound)
        return float(np.mean(proofs))

    def __str__(self) -> str:
        """Say what is proved, in one line."""
        mass, demand = self.network.mass_unit, ""
        if self.min_service is not None and self.network.services:
            demand = f", expected service level at least {levels_text(self.network, self.min_service)}"
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


def draw(
    network: Network, agents: Sequence[str] | None, initial: Floats | None, numbers: bool, first: int, count: int
) -> list[Draw]:
    """Return what episodes with seeds from ``first`` on draw."""
    draws_numbers = numbers and bool(network.uncertain)
    env = MultiAgentVectorEnv(network, num_envs=count, agents=agents or None, uncertain=draws_numbers)
    env.reset(seed=first)
    return draws_of(env, initial)


def uncertain_bound(
    network: Network,
    agents: Sequence[str] | None,
    initial: Mapping[str, float] | ArrayLike | None,
    min_service: Floats | None,
    degree: int,
    sampling: Sampling,
    progress: Callable[[float], None] = lambda share: None,
) -> UncertainBound:
    """Bound the mean of λ̄ of policies that do not foresee; see ``bound``, which checks the arguments.

    Raises:
        CirlError: if nothing is uncertain, the program of a draw is too large, or services are out of reach.
        NoCertificate: for a network whose flows are not linear laws.
    """
    sampling.check()
    if not network.disturbed and not (network.uncertain and sampling.numbers):
        raise CirlError(f"network '{network.name}': nothing disturbs it and no number is drawn; leave out uncertain")
    first, actors = first_seed(sampling.seed), MultiAgentVectorEnv(network, num_envs=1, agents=agents).agents
    start = None if initial is None else starting_stocks(Lifetimes(network, actors), initial)
    futures = draw(network, agents, start, sampling.numbers, first + SEED_SPACING // 2, sampling.fit_draws)
    programs = []
    for future in futures:
        programs.append(DrawProgram(future, agents, degree))
        check_size(programs[-1])
    demand = np.zeros(0) if min_service is None else min_service
    scale = network.objective.circularity_scale
    clairvoyant, prices = fit_prices(programs, demand, scale, progress=lambda share: progress(0.3 * share))
    proofs = prove_draws(
        network, actors, start, degree, sampling, (clairvoyant, prices), lambda share: progress(0.3 + 0.7 * share)
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
        gross_mass=proofs.gross_mass,
        certificates=proofs.certificates,
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


@positional_record
class Proofs:
    """What is proved of draws under some prices."""

    values: Annotated[Floats, "shape (draws, prices), mass"]
    gross_mass: Annotated[Floats, "gross mass that λ counts in the plan under the last prices, shape (draws,)"]
    certificates: Annotated[tuple[Certificate, ...], "multipliers under the last prices"]


def prove_draws(
    network: Network,
    agents: Sequence[str],
    initial: Floats | None,
    degree: int,
    sampling: Sampling,
    prices: Sequence[Prices],
    progress: Callable[[float], None] = lambda share: None,
) -> Proofs:
    """Prove a bound of every draw under some prices, none of them left out."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) if sampling.directory is None else sampling.directory
        first = first_seed(sampling.seed)
        digest = _digest(network, agents, initial, degree, sampling.numbers, prices)
        jobs = [
            ProofJob(
                name=f"draws-{digest}-{first + begin}-{min(CHUNK, sampling.draws - begin)}",
                network=network,
                agents=tuple(agents),
                initial=initial,
                degree=degree,
                numbers=sampling.numbers,
                first=first + begin,
                count=min(CHUNK, sampling.draws - begin),
                prices=tuple(prices),
                folder=folder,
            )
            for begin in range(0, sampling.draws, CHUNK)
        ]

        def watch(statuses: Sequence[JobStatus]) -> None:
            progress(sum(status.share for status in statuses) / len(statuses))

        on, workers, settings = sampling.on, sampling.workers, sampling.settings
        raise_first(run_jobs(jobs, folder / "jobs", on=on, workers=workers, settings=settings, watch=watch))
        parts = [job.proofs() for job in jobs]
    proofs = Proofs(
        np.concatenate([part.values for part in parts]),
        np.concatenate([part.gross_mass for part in parts]),
        tuple(certificate for part in parts for certificate in part.certificates),
    )
    if len(proofs.values) != sampling.draws or np.isnan(proofs.values).any():
        raise CirlError(f"{len(proofs.values)} of {sampling.draws} draws have a bound; every one counts")
    return proofs


def _digest(
    network: Network,
    agents: Sequence[str],
    initial: Floats | None,
    degree: int,
    numbers: bool,
    prices: Sequence[Prices],
) -> str:
    """Return what tells proofs of one question from those of another."""
    hashed = hashlib.sha256(repr((fingerprint(network), tuple(agents), degree, numbers)).encode())
    arrays = [getattr(price, part.name) for price in prices for part in fields(price)]
    for array in [np.zeros(0) if initial is None else initial, *arrays]:
        hashed.update(repr(np.shape(array)).encode() + np.ascontiguousarray(array, dtype=float).tobytes())
    return hashed.hexdigest()[:16]


@frozen_record
class ProofJob:
    """The proofs of some draws, as a job, whose name says what they are of."""

    name: str
    network: Network
    agents: tuple[str, ...]
    initial: Floats | None
    degree: int
    numbers: bool
    first: int
    count: int
    prices: tuple[Prices, ...]
    folder: Path

    @property
    def path(self) -> Path:
        """Where its proofs are."""
        return self.folder / f"{self.name}.npz"

    def is_done(self) -> bool:
        """Return whether they are there."""
        return self.path.is_file()

    def run(self, tell: Tell) -> None:
        """Prove them, each from the basis of the one before."""
        draws = draw(self.network, self.agents, self.initial, self.numbers, self.first, self.count)
        values, gross_mass = np.empty((self.count, len(self.prices))), np.full(self.count, np.nan)
        arrays: dict[str, Any] = {"values": values, "gross_mass": gross_mass}
        certificates: list[Certificate] = []
        basis = None
        for i, future in enumerate(draws):
            program = DrawProgram(future, self.agents or None, self.degree)
            for k, prices in enumerate(self.prices):
                proof = program.prove(program.with_prices(prices), basis, certificates)
                basis, values[i, k] = proof.basis or basis, proof.value
                certificates = [proof.certificate, *certificates][: 2 * len(self.prices)]
            if proof.plan is not None:
                weights = np.abs(circularity_weights(program.layout))
                weights[program.layout.imbalance] = 0.0
                gross_mass[i] = proof.plan.reshape(self.network.episode.horizon, -1).mean(axis=0) @ weights
            arrays[f"equal{i}"], arrays[f"under{i}"] = proof.certificate.equal, proof.certificate.under
            tell("proving", i + 1, self.count)

        def write(path: Path) -> None:
            with path.open("wb") as file:
                np.savez(file, **arrays)

        write_atomically(self.path, write)

    def proofs(self) -> Proofs:
        """Read them."""
        with np.load(self.path) as arrays:
            certificates = [
                Certificate(equal=arrays[f"equal{i}"], under=arrays[f"under{i}"]) for i in range(self.count)
            ]
            return Proofs(arrays["values"], arrays["gross_mass"], tuple(certificates))
