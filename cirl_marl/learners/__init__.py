"""Stable-Baselines3 learners, one per agent, learning together in one coupled environment.

What trains loads torch, and does so when it is first asked for: reading a run or a recipe does not.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.learners.run_directory import RunDirectory

if TYPE_CHECKING:
    from cirl_marl.learners.interface import Trained, complete_run, export, resume, train, train_seeds
    from cirl_marl.learners.teams.team import Team, independent
    from cirl_marl.learners.trainer import Progress, Training

__all__ = [
    "Progress",
    "Recipe",
    "RunDirectory",
    "Team",
    "Trained",
    "Training",
    "complete_run",
    "export",
    "independent",
    "load_recipe",
    "resume",
    "train",
    "train_seeds",
]

_HOME = {
    **dict.fromkeys(("Trained", "complete_run", "export", "resume", "train", "train_seeds"), "interface"),
    **dict.fromkeys(("Team", "independent"), "teams.team"),
    **dict.fromkeys(("Progress", "Training"), "trainer"),
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
