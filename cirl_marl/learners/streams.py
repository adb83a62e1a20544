"""One set of global random streams and torch modes per learner.

Stable-Baselines3 draws from the global torch and NumPy streams, and torch keeps its gradient mode per thread. Learners
that take turns in one thread would therefore read each other's streams; each gets its own instead, exchanged at every
switch, so that a learner computes exactly what it would compute alone.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.random.mtrand import get_bit_generator, set_bit_generator
from stable_baselines3.common.utils import set_random_seed

from cirl_marl.errors import CirlError

_IN_USE = threading.Lock()


class Streams:
    """The torch, NumPy and gradient-mode state of one learner while it is not running.

    NumPy's legacy stream caches one Gaussian; exchanging bit generators drops it, saving the full state keeps it but
    costs some 50 µs. ``keep_gaussian`` is for learners with action noise, the only ones that draw such Gaussians.
    """

    def __init__(self, seed: int | None = None, *, keep_gaussian: bool = False) -> None:
        """Start fresh streams as Stable-Baselines3 seeds them; without a seed, take the ones that are active now."""
        self.keep_gaussian = keep_gaussian
        if seed is None:
            self._leave()
            return
        with global_streams_kept():
            set_bit_generator(np.random.MT19937())
            set_random_seed(seed)
            torch.set_grad_enabled(True)
            self._leave()

    @property
    def bit_generator(self) -> np.random.BitGenerator:
        """The NumPy stream itself, while it is not active; who draws from it moves it on."""
        return self._numpy

    @property
    def torch_state(self) -> torch.Tensor:
        """State of the torch stream, while it is not active."""
        return self._torch

    @torch_state.setter
    def torch_state(self, state: torch.Tensor) -> None:
        self._torch = state

    def told(self, *, active: bool) -> dict[str, Any]:
        """Return the state of the streams, which are the ``active`` ones or put away."""
        if active:
            self._leave()
        numpy = self._numpy.state if self._numpy_state is None else self._numpy_state
        return {"torch": self._torch, "numpy": numpy, "gaussian": self._numpy_state is not None}

    def go_on(self, told: Mapping[str, Any], *, active: bool) -> None:
        """Bring the streams into a state."""
        self._torch, state = told["torch"], told["numpy"]
        self._numpy.state = {"bit_generator": state["bit_generator"], "state": state["state"]}
        self._numpy_state = state if told["gaussian"] else None
        if active:
            self._enter()

    @contextmanager
    def active(self) -> Iterator[None]:
        """Run the block with these streams; the ones active before come back after it."""
        with global_streams_kept():
            self._enter()
            try:
                yield
            finally:
                self._leave()

    def switch_to(self, other: Streams) -> None:
        """Put these away and make ``other`` the active ones."""
        self._leave()
        other._enter()

    def _leave(self) -> None:
        self._torch = torch.get_rng_state()
        self._grad = torch.is_grad_enabled()
        self._numpy = get_bit_generator()
        self._numpy_state = np.random.get_state(legacy=False) if self.keep_gaussian else None  # noqa: NPY002 (Stable-Baselines3 draws from it)

    def _enter(self) -> None:
        torch.set_rng_state(self._torch)
        torch.set_grad_enabled(self._grad)
        set_bit_generator(self._numpy)
        if self._numpy_state is not None:
            np.random.set_state(self._numpy_state)  # noqa: NPY002


@contextmanager
def global_streams_kept() -> Iterator[None]:
    """Put the global torch, NumPy and Python streams and the gradient mode back after the block."""
    python = random.getstate()
    before = Streams(keep_gaussian=True)
    try:
        yield
    finally:
        before._enter()
        random.setstate(python)


@contextmanager
def global_streams_claimed() -> Iterator[None]:
    """Keep the global streams of this process for one training; a ``CirlError`` if another training has them."""
    if not _IN_USE.acquire(blocking=False):
        raise CirlError("another training is under way in this process and draws from its random streams; use another")
    try:
        yield
    finally:
        _IN_USE.release()
