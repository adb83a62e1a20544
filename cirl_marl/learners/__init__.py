"""Stable-Baselines3 learners, one per agent, learning together in one coupled environment.

What trains loads torch, and does so when it is first asked for: reading a run or a recipe does not.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.learners.run import RunDirectory

if TYPE_CHECKING:
    from cirl_marl.learners.exporting import export
    from cirl_marl.learners.launch import resume, train, train_seeds
    from cirl_marl.learners.training import Progress, Training

__all__ = ["Progress", "Recipe", "RunDirectory", "Training", "export", "load_recipe", "resume", "train", "train_seeds"]

_HOME = {
    **dict.fromkeys(("Progress", "Training"), "training"),
    **dict.fromkeys(("resume", "train", "train_seeds"), "launch"),
    "export": "exporting",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
