"""Policies between two checkpoints of a training, by linear interpolation of weights and moments.

Multipliers make services swing about what is demanded, and steps get small before the swings end: the last policies
often lack a thousandth of a service, and those that serve came much earlier. Both are of one training and near each
other, so that a mean of their numbers acts between them (Wortsman et al. 2022, Model soups, arXiv 2203.05482).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from cirl_marl.learners.checkpoint import observation_statistics
from cirl_marl.learners.learner import Learner


class WeightPath:
    """Learners whose policies move between those of their origins, at 0, and their own, at 1."""

    def __init__(self, learners: Mapping[str, Learner], origins: Mapping[str, Learner]) -> None:
        """Begin where the ``learners`` are; ``origins`` have the same names and shapes, and are not needed later."""
        self._learners = learners
        self._ends = {name: (_numbers(origins[name]), _numbers(learner)) for name, learner in learners.items()}

    def set(self, share: float) -> None:
        """Give the learners a ``share`` of their own numbers and the rest of their origins'; 1 is exact."""
        for name, learner in self._learners.items():
            origin, end = self._ends[name]
            numbers = {key: (1.0 - share) * origin[key] + share * value for key, value in end.items()}
            state = learner.model.policy.state_dict()
            learner.model.policy.load_state_dict({key: numbers[key] for key in state})
            for key, part in _moments(learner):
                setattr(part, key[-1], numbers[key])


def _numbers(learner: Learner) -> dict[Any, Any]:
    """Return copies of the weights of a policy and of the moments of what it observes."""
    weights = {key: value.clone() for key, value in learner.model.policy.state_dict().items()}
    return weights | {key: getattr(part, key[-1]).copy() for key, part in _moments(learner)}


def _moments(learner: Learner) -> Iterator[tuple[tuple[str, str], Any]]:
    """Yield the names of moments and what has them."""
    if learner.normaliser is not None:
        for key, part in observation_statistics(learner.normaliser).items():
            yield from (((key, name), part) for name in ("mean", "var"))
