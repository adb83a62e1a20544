"""Bounds of tasks: what is proved of every episode of the evaluation, with prices on the services, in a small file."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.rollout import first_seed, starting_stocks
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import RunError
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import frozen_record
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.certificate import Certificate, verify
from cirl_marl.optimum.options import DEGREE
from cirl_marl.optimum.program import Programs
from cirl_marl.records.files import write_atomically


@frozen_record
class TaskBound:
    """What no policy exceeds on average: E[λ̄ + Σ_s μ_s (level_s − demand_s)] ≤ E[values].

    Where the future is known it holds in every episode. Multipliers of one linear program prove it for all starts:
    their bound is linear in the levels demanded, with slopes −μ, so that every level has its price (weak duality).
    """

    values: Annotated[Floats, "what is proved of each episode, shape (episodes,), mass"]
    prices: Annotated[Floats, "μ ≥ 0 of the mean level of each service, shape (services,), mass"]
    demand: Annotated[Floats, "level demanded of each, shape (services,)"]
    scale: Annotated[
        float,
        "by which gaps are divided, mass: |mean of values|, or the gross mass that λ counts where that is close to 0",
    ]
    half_width: Annotated[float, "of the one-sided 95 % interval of the mean of values, mass; 0 if nothing is drawn"]
    equal: Annotated[Floats, "multipliers of the equalities; empty if the bound is of draws, each with its own"]
    under: Annotated[Floats, "of the inequalities, likewise"]

    def gaps(self, circularity: ArrayLike, levels: ArrayLike) -> Floats:
        """Return (value − λ̄ − Σ_s μ_s (level_s − demand_s))/scale of each episode, of all or the first.

        Args:
            circularity: λ̄, shape (episodes,).
            levels: mean levels of the services, shape (episodes, services).
        """
        merit = np.asarray(circularity, dtype=float) + (np.asarray(levels) - self.demand) @ self.prices
        return np.asarray((self.values[: len(merit)] - merit) / self.scale)

    def write(self, path: Path) -> None:
        """Write the file."""
        arrays = {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}

        def save(place: Path) -> None:
            with place.open("wb") as file:
                np.savez_compressed(file, **arrays)  # type: ignore[arg-type]

        write_atomically(path, save)

    @classmethod
    def read(cls, path: Path) -> TaskBound:
        """Read the file; a ``RunError`` if it is something else."""
        try:
            with np.load(path, allow_pickle=False) as arrays:
                parts = {field.name: arrays[field.name] for field in fields(cls)}
                return cls(**{name: part if part.ndim else float(part) for name, part in parts.items()})  # type: ignore[arg-type]
        except (OSError, ValueError, KeyError) as error:
            raise RunError(f"{path}: is not the bound of a task: {error!r}") from error

    def recompute(self, network: Network, seed: int) -> Floats:
        """Return what the multipliers prove of each episode, computed anew without a solver, shape (episodes,), mass.

        Raises:
            RunError: if the bound has no multipliers of its own.
        """
        if not len(self.equal):
            raise RunError(f"network '{network.name}': each draw of its bound has multipliers, which are not kept")
        starts = starting_stocks(MultiAgentVectorEnv(network, num_envs=len(self.values)), first_seed(seed))
        return values_at(network, starts, Certificate(equal=self.equal, under=self.under), self.demand)


def values_at(network: Network, starts: Floats, certificate: Certificate, demand: Floats) -> Floats:
    """Return what multipliers prove of episodes from some starts, shape (episodes,), mass.

    Those that have none for rows of shortages are of programs without them, as tasks of version 1 have them.
    """
    admissible, levels = Admissible.of(network, None), demand if len(demand) else None
    programs = Programs(admissible, DEGREE, None)
    if len(programs.program(starts[0], levels).under_to) != len(certificate.under):
        programs = Programs(admissible, DEGREE, None, shortages=False, system=programs.system)
    problems = (programs.program(start, levels) for start in starts)
    return np.array([verify(problem, certificate, np.zeros(len(problem.cost))).bound for problem in problems])
