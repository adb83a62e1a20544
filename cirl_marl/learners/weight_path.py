"""Policies near those of a training, of which some serve where its last do not: means, and what is between two.

Multipliers make services swing about what is demanded, and steps get small before the swings end: the last policies
often lack a thousandth of a service, and those that serve came much earlier. The mean of the last policies is what
they swing about. All are of one training and near each other, so that means of their numbers act between them (Wortsman
et al. 2022, Model soups, arXiv 2203.05482).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from cirl_marl.learners.checkpoint import observation_statistics
from cirl_marl.learners.learner import Learner
from cirl_marl.learners.stacked.perceptrons import MEAN, networks_of

PolicyNumbers = Mapping[str, Mapping[Any, Any]]
"""Weights of policies and moments of what they observe, by learner."""


class WeightPath:
    """Learners whose policies move between two sets of numbers."""

    def __init__(self, learners: Mapping[str, Learner], origins: PolicyNumbers, ends: PolicyNumbers) -> None:
        """Take the numbers at 0 and at 1; the ``learners`` stay as they are."""
        self._learners, self._origins, self._ends = learners, origins, ends

    def set(self, share: float) -> None:
        """Give the learners a ``share`` of the numbers at the end and the rest of their origins'; 1 is exact."""
        for name, learner in self._learners.items():
            origin, end = self._origins[name], self._ends[name]
            numbers = {key: (1.0 - share) * origin[key] + share * value for key, value in end.items()}
            state = learner.model.policy.state_dict()
            learner.model.policy.load_state_dict({key: numbers[key] for key in state})
            for key, part in _moments(learner):
                setattr(part, key[-1], numbers[key])


def numbers_of(learners: Mapping[str, Learner]) -> PolicyNumbers:
    """Return copies of the numbers of learners."""
    return {
        name: {key: value.clone() for key, value in learner.model.policy.state_dict().items()}
        | {key: getattr(part, key[-1]).copy() for key, part in _moments(learner)}
        for name, learner in learners.items()
    }


def mean_numbers(learners: Mapping[str, Learner]) -> PolicyNumbers:
    """Return the numbers of learners with the running means of the weights that exact gradients move."""
    numbers = {}
    for name, last in numbers_of(learners).items():
        policy = learners[name].model.policy
        states = networks_of(policy).optimiser.state
        parts = {key: states.get(weight, {}) for key, weight in policy.named_parameters()}
        numbers[name] = {**last, **{key: state[MEAN] for key, state in parts.items() if MEAN in state}}
    return numbers


def _moments(learner: Learner) -> Iterator[tuple[tuple[str, str], Any]]:
    """Yield the names of moments and what has them."""
    if learner.normaliser is not None:
        for key, part in observation_statistics(learner.normaliser).items():
            yield from (((key, name), part) for name in ("mean", "var"))
