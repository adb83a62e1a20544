"""Learners of the same settings that run as one: what does not depend on their algorithm."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from cirl_marl.learners.learner import Learner
from cirl_marl.learners.stacked.inputs import Inputs


class Stack(ABC):
    """Learners of the same settings, from which it takes everything and to which ``give`` brings it back.

    Attributes:
        members: the learners, whose order is that of all leading axes.
    """

    def __init__(self, members: Sequence[Learner], device: str = "cpu") -> None:
        """Take over what all learners have."""
        self.members = list(members)
        self._device = torch.device(device)
        self._inputs = Inputs(members, self._device)
        # Noise comes from a copy of each learner's torch stream.
        self._noise = [torch.Generator().set_state(learner.streams.torch_state) for learner in members]
        self._moves, self._given = 0, 0

    @abstractmethod
    def learn(self, steps: int, wait: Callable[[], None]) -> None:
        """Learn for the share of ``steps`` that is the learners'; ``wait`` returns when the environments have moved."""

    def act(self, wait: Callable[[], None]) -> None:
        """Act for ever without noise, learning nothing."""
        while True:
            self._reached()
            self._inputs.hand_in(self._best(self._inputs.observed(learning=False)))
            wait()

    @property
    def _resuming(self) -> bool:
        """Whether the learners go on from where they were saved, and have not come there yet."""
        return any(each.boundary.resuming for each in self.members)

    def _reached(self) -> None:
        """Let the members be saved, or go on."""
        if any(each.boundary.folder is not None for each in self.members):
            self.give()
        for each in self.members:
            each.boundary.reached()

    def give(self) -> None:
        """Bring models, normalisers and random streams up to date, as if each learner had learnt by itself."""
        if self._given == self._moves:
            return
        self._given = self._moves
        self._inputs.give()
        self._give_models()
        for learner, noise in zip(self.members, self._noise, strict=True):
            learner.streams.torch_state = noise.get_state()

    @abstractmethod
    def _best(self, seen: Tensor) -> Tensor:
        """Return actions without noise, shape (learners, rows, entries), for what is seen."""

    @abstractmethod
    def _give_models(self) -> None:
        """Bring models up to date."""

    def _move(self, actions: Tensor, wait: Callable[[], None]) -> Tensor:
        """Act while learning; return what is seen then."""
        self._inputs.hand_in(actions)
        wait()
        self._moves += 1
        return self._inputs.observed(learning=True)
