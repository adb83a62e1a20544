"""Environments of this library for the learners of others: TorchRL, BenchMARL, RLlib, and one policy for all by SB3.

Each module needs the package that it is for, which this library does not install:

- ``adapters.torchrl``: ``TorchRLEnv``, the batched environment, all copies in one step;
- ``adapters.benchmarl``: ``NetworkTask``, the same as a task;
- ``adapters.rllib``: ``RLlibEnv``, whose agents RLlib steps one environment at a time;
- ``adapters.differentiable``: ``DifferentiableEnv``, through which gradients of PyTorch flow; it needs nothing more;
- ``adapters.supersuit``: ``SharedPolicyEnv``, all agents as copies of one, for a plain Stable-Baselines3 model.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needs(package: str, requirement: str) -> Iterator[None]:
    """Say what to install if an import in the block fails because ``package`` is missing.

    Raises:
        ModuleNotFoundError: with ``requirement``, as pip takes it.
    """
    try:
        yield
    except ModuleNotFoundError as missing:
        message = f"this adapter needs the package {package}, which is not installed: pip install {requirement}"
        raise ModuleNotFoundError(message, name=package) from missing
