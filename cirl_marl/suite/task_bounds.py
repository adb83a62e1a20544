"""Bounds of tasks: what is proved of every episode of the evaluation, with prices on the services, in a small file."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.rollout import first_seed, starting_stocks
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import RunError
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import frozen_record
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.certificate import Certificate, verify
from cirl_marl.optimum.options import DEGREE
from cirl_marl.optimum.program import Program, Programs
from cirl_marl.records.files import write_atomically

SAME_ROW = 1e-9
"""Relative difference of two names up to which they are of the same row, computed by other versions or machines."""


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
    rows: Annotated[Floats, "names of those whose multiplier is not 0, at the mean of the starts; see ``row_names``"]

    def gaps(self, circularity: ArrayLike, levels: ArrayLike) -> Floats:
        """Return (value − λ̄ − Σ_s μ_s (level_s − demand_s))/scale of each episode, of all or the first.

        Args:
            circularity: λ̄, shape (episodes,).
            levels: mean levels of the services, shape (episodes, services).
        """
        merit = np.asarray(circularity, dtype=float) + (np.asarray(levels) - self.demand) @ self.prices
        return np.asarray((self.values[: len(merit)] - merit) / self.scale)

    def write(self, path: Path) -> None:
        """Write the file, and beside it the names of rows, if it has multipliers."""
        arrays = {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}
        rows = arrays.pop("rows")
        _save(path, arrays)
        if len(self.equal):
            _save(rows_path(path), {"rows": rows})

    @classmethod
    def read(cls, path: Path) -> TaskBound:
        """Read the file, and the names of rows beside it; a ``RunError`` if one is something else."""
        place = path
        try:
            parts = {"rows": np.zeros(0)} | _load(place)
            if len(parts["equal"]):
                place = rows_path(path)
                parts |= _load(place)
            return cls(**{field.name: parts[field.name] for field in fields(cls)})
        except (OSError, ValueError, KeyError) as error:
            raise RunError(f"{place}: is not the bound of a task: {error!r}") from error

    def recompute(self, network: Network, seed: int) -> Floats:
        """Return what the multipliers prove of each episode, computed anew without a solver, shape (episodes,), mass.

        Rows that the program has got since have none, and those of rows that it no longer has prove nothing.

        Raises:
            RunError: if the bound has no multipliers of its own.
        """
        if not len(self.equal):
            raise RunError(f"network '{network.name}': each draw of its bound has multipliers, which are not kept")
        starts = starting_stocks(MultiAgentVectorEnv(network, num_envs=len(self.values)), first_seed(seed))
        return values_at(network, starts, Certificate(equal=self.equal, under=self.under), self.demand, self.rows)


def values_at(
    network: Network, starts: Floats, certificate: Certificate, demand: Floats, rows: Floats | None = None
) -> Floats:
    """Return what multipliers prove of episodes from some starts, shape (episodes,), mass.

    With the names of their ``rows`` they may be of a program that has other rows beside these.
    """
    programs, levels = Programs(Admissible.of(network, None), DEGREE, None), demand if len(demand) else None
    if rows is not None:
        present = row_names(programs.program(starts.mean(axis=0), levels))
        certificate = replace(certificate, under=_of_rows(present, rows, certificate.under[certificate.under != 0]))
    problems = (programs.program(start, levels) for start in starts)
    return np.array([verify(problem, certificate, np.zeros(len(problem.cost))).bound for problem in problems])


def rows_path(path: Path) -> Path:
    """Return where the names of the rows of a bound are kept: versions that had none hash its file alone."""
    return path.with_name(f"{path.stem}.rows.npz")


def row_names(problem: Program) -> Floats:
    """Return a name of each inequality: what it is of fixed random numbers in place of the variables.

    It is the same wherever the row stands, and whichever others there are.
    """
    # of PCG64 NumPy promises the same numbers in all versions
    return np.asarray(problem.under @ (1.0 + np.random.PCG64(0).random_raw(len(problem.cost)) / 2.0**64))


def _of_rows(present: Floats, names: Floats, multipliers: Floats) -> Floats:
    """Return multipliers of rows whose names are ``present``, given those of some ``names``; 0 where there is none."""
    order: Integers = np.argsort(present)
    place = np.searchsorted(present[order], names)
    nearest = np.stack([order[np.clip(place - side, 0, len(present) - 1)] for side in (0, 1)])
    row = np.take_along_axis(nearest, np.abs(present[nearest] - names).argmin(axis=0)[None], axis=0)[0]
    is_same = np.abs(present[row] - names) <= SAME_ROW * np.abs(names)
    under = np.zeros(len(present))
    np.add.at(under, row[is_same], multipliers[is_same])
    return under


def _load(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as arrays:
        return {name: part if part.ndim else float(part) for name, part in arrays.items()}


def _save(path: Path, arrays: dict[str, Floats]) -> None:
    def save(place: Path) -> None:
        with place.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]

    write_atomically(path, save)
