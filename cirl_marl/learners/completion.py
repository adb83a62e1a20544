"""A training that is begun, gone on with or left alone, whatever there is of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cirl_marl.learners.recipe import Recipe
from cirl_marl.learners.run import RunDirectory
from cirl_marl.network import Network

if TYPE_CHECKING:
    from cirl_marl.learners.training import Progress


def completed(
    directory: Path,
    network: str | Path | Network,
    recipe: Recipe,
    *,
    report: Callable[[Progress], None] | None = None,
    checkpoint_every: float | None = None,
    **options: Any,
) -> RunDirectory:
    """Return the complete run of a directory: trained from the beginning, from its last checkpoint, or not at all.

    A run that is there is taken for the right one. The arguments are those of ``train``, and the bits do not depend on
    where it was interrupted.
    """
    from cirl_marl.learners.launch import resume, train  # they need torch

    run = RunDirectory(directory)
    how: dict[str, Any] = {"report": report, "checkpoint_every": checkpoint_every}
    if not (directory / "config.json").is_file():
        train(network, recipe, directory=directory, **how, **options)
    elif run.status["state"] != "complete":
        resume(directory, **how)
    return run
