"""Draws of an uncertain network, in numbers that an interval needs, and what is proved of each, as jobs."""

from __future__ import annotations

import hashlib
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from cirl_marl.controllers.rollout import SEED_SPACING, first_seed
from cirl_marl.definitions.writer import fingerprint
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, whole_number
from cirl_marl.jobs import JobStatus, Tell, check_place, raise_first, run_jobs
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import frozen_record, positional_record
from cirl_marl.optimum.aims import Aims
from cirl_marl.optimum.certificate import Certificate
from cirl_marl.optimum.draws import Draw, DrawProgram, Prices, draws_of
from cirl_marl.optimum.program import circularity_weights
from cirl_marl.records.files import write_atomically

FEWEST, FEWEST_FITTED = 10, 4
"""Draws below which no interval is given, and to which no prices are fitted."""
FEWEST_OTHERS = 3
"""Draws that have to meet something else than most do: with fewer, Student's interval is far too narrow."""
CHUNK = 8
"""Draws of a job."""


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
    directory: Annotated[str | Path | None, "where what is done is kept, for machines that share it; None: nowhere"] = (
        None
    )

    def validate(self) -> Sampling:
        """Return it with numbers of Python and a path of pathlib.

        Raises:
            CirlError: for what is no number, too few draws, or a place that cannot be used.
        """
        draws, fit_draws = whole_number("draws", self.draws, 1), whole_number("fit_draws", self.fit_draws, 1)
        for name, count, least in (("draws", draws, FEWEST), ("fit_draws", fit_draws, FEWEST_FITTED)):
            if count < least:
                raise CirlError(f"{name} {count}: too few for an interval, at least {least}")
            if count > SEED_SPACING // 2:
                raise CirlError(f"{name} {count}: at most {SEED_SPACING // 2:,}")
        if not isinstance(self.numbers, bool):
            raise CirlError(f"numbers must be True or False, got {self.numbers!r}")
        if not isinstance(self.settings, Mapping):
            raise CirlError(f"settings must be a mapping of options of sbatch to values, got {self.settings!r}")
        check_place(self.on, self.workers, self.settings)
        if self.on == "slurm" and self.directory is None:
            raise CirlError("on 'slurm' needs a directory that all machines share")
        if not isinstance(self.directory, str | Path | None):
            raise CirlError(f"directory must be a path, got {self.directory!r}")
        seed, directory = whole_number("seed", self.seed, 0), None if self.directory is None else Path(self.directory)
        return replace(self, draws=draws, fit_draws=fit_draws, seed=seed, directory=directory)

    def check_paths(self, network: Network) -> None:
        """Refuse draws nearly all of which meet the same: no interval is known of what hardly ever happens.

        Raises:
            CirlError: with about how many draws would do.
        """
        if not network.disturbed or (self.numbers and network.uncertain):
            return
        first = first_seed(self.seed)
        paths = network.processes.sample(range(first, first + self.draws)).values
        counts = np.unique(paths.reshape(-1, self.draws), axis=1, return_counts=True)[1]
        others = self.draws - int(counts.max())
        if others < FEWEST_OTHERS:
            enough = math.ceil(2 * FEWEST_OTHERS * self.draws / max(others, 1))
            raise CirlError(
                f"network '{network.name}': {self.draws - others} of {self.draws} draws meet the same disturbances, so "
                f"that the others are too few for an interval; take some {enough:,} draws"
            )


def draw(
    network: Network, agents: Sequence[str] | None, initial: Floats | None, numbers: bool, first: int, count: int
) -> list[Draw]:
    """Return what episodes with seeds from ``first`` on draw."""
    draws_numbers = numbers and bool(network.uncertain)
    env = MultiAgentVectorEnv(network, num_envs=count, agents=agents or None, uncertain=draws_numbers)
    env.reset(seed=first)
    return draws_of(env, initial)


@positional_record
class Proofs:
    """What is proved of draws under some prices."""

    values: Annotated[Floats, "shape (draws, prices), mass"]
    luck: Annotated[Floats, "what is new in each draw by itself, likewise"]
    gross_mass: Annotated[Floats, "gross mass that λ counts in the plan under the last prices, shape (draws,)"]
    certificates: Annotated[tuple[Certificate, ...], "multipliers under the last prices"]


def prove_draws(
    network: Network,
    agents: Sequence[str],
    initial: Floats | None,
    degree: int,
    sampling: Sampling,
    prices: Sequence[Prices],
    aims: Aims,
    progress: Callable[[float], None] = lambda share: None,
) -> Proofs:
    """Prove a bound of every draw under some prices, none of them left out."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary if sampling.directory is None else sampling.directory)
        first = first_seed(sampling.seed)
        digest = _digest(network, agents, initial, degree, sampling.numbers, prices, aims)
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
                aims=aims,
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
        np.concatenate([part.luck for part in parts]),
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
    aims: Aims,
) -> str:
    """Return what tells proofs of one question from those of another."""
    question = (fingerprint(network), tuple(agents), degree, numbers, *aims.budgets)
    hashed = hashlib.sha256(repr(question).encode())
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
    aims: Aims
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
        luck = np.array([[prices.luck(future.new) for prices in self.prices] for future in draws])
        arrays: dict[str, Any] = {"values": values, "luck": luck, "gross_mass": gross_mass}
        certificates: list[Certificate] = []
        basis = None
        for i, future in enumerate(draws):
            program = DrawProgram(future, self.agents or None, self.degree, aims=self.aims)
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
            return Proofs(arrays["values"], arrays["luck"], arrays["gross_mass"], tuple(certificates))
