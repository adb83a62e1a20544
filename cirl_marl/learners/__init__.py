"""Stable-Baselines3 learners, one per agent, learning together in one coupled environment."""

from cirl_marl.learners.launch import resume, train
from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.learners.run import RunDirectory
from cirl_marl.learners.training import Progress, Training

__all__ = ["Progress", "Recipe", "RunDirectory", "Training", "load_recipe", "resume", "train"]
