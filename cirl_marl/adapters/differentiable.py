"""A differentiable view of the batched environment for PyTorch: one node of automatic differentiation per interval."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cirl_marl.environments.derivatives import Derivatives, Outputs
from cirl_marl.environments.parallel import vector_env
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import ControlError
from cirl_marl.network import Network


class DifferentiableEnv:
    """Copies of a network as a function of actions, start and disturbances, through which gradients flow.

    ``step`` runs the simulator of ``MultiAgentVectorEnv``; the way back is its exact adjoint (``gradient`` says which
    one-sided derivatives are taken at kinks). Gradients go through observations, and so through policies that see them:

    >>> import torch
    >>> from cirl_marl import DifferentiableEnv
    >>> env = DifferentiableEnv("copper_net", num_envs=2, horizon=3)
    >>> observation, total = env.reset(seed=0), 0.0
    >>> weight = torch.zeros(16, len(observation), dtype=torch.float64, requires_grad=True)
    >>> for _ in range(3):
    ...     observation, circularity, levels = env.step(torch.clamp(weight @ observation, -1.0, 1.0))
    ...     total = total + circularity.mean() / 3
    >>> total.backward()
    >>> weight.grad.shape
    torch.Size([16, 98])

    Attributes:
        env: the environment.
        start: masses at the start of the episode, shape (masses, B), a leaf whose ``grad`` is filled.
        disturbances: their values, shape (intervals, names, B), likewise.
        bookings: discounted amounts that the last interval booked on accounts, shape (accounts, B).
    """

    bookings: Tensor
    start: Tensor
    disturbances: Tensor

    def __init__(self, network: str | Path | Network, *, num_envs: int = 64, **options: Any) -> None:
        """Make the environment; arguments are those of ``vector_env``.

        Raises:
            CirlError: for what has no derivative; names the network, the compartment and the reason.
        """
        self.env: MultiAgentVectorEnv = vector_env(network, num_envs=num_envs, **options)
        self._derivatives = Derivatives(self.env)
        self._stock: Tensor | None = None

    def reset(self, seed: int | Sequence[int] | None = None) -> Tensor:
        """Start an episode in every copy; return the stacked observation, shape (entries of all agents, B).

        That first observation counts as given: no gradient flows from it to start and disturbances.
        """
        self.env.reset(seed)
        state = self.env.physical
        self.start = torch.tensor(state.stock, requires_grad=True)
        self.disturbances = torch.tensor(state.disturbances, requires_grad=True)
        self._stock = self.start
        return torch.tensor(self._derivatives.observation())

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Hold stacked actions in [−1, 1], shape (entries, B), for one control interval.

        Returns:
            the observation, shape (entries of all agents, B), the mean of λ over the interval, shape (B,), and the
            service levels, shape (services, B); double precision.

        Raises:
            ControlError: for another shape, NaN, values out of bounds, or an episode that is over or not begun.
        """
        if self._stock is None:
            raise ControlError("the environment has no state yet: call reset() first")
        shape = (len(self.env.actuators.control_rows), self.env.num_envs)
        if not isinstance(actions, Tensor) or actions.shape != shape:
            form = f"shape {tuple(actions.shape)}" if isinstance(actions, Tensor) else type(actions).__name__
            raise ControlError(f"actions are a tensor of shape {shape}, got {form}")
        outputs: Any = _Interval.apply(self._derivatives, self._stock, actions, self.disturbances)  # type: ignore[no-untyped-call]
        self._stock, circularity, levels, observation, self.bookings = outputs
        return observation, circularity, levels


class _Interval(torch.autograd.Function):
    """(x, a, ξ) → (x', λ, levels, observation, accounts), by the kernels of the simulator."""

    @staticmethod
    def forward(ctx: Any, derivatives: Derivatives, stock: Tensor, actions: Tensor, paths: Tensor) -> Any:
        ctx.derivatives, ctx.dtype = derivatives, actions.dtype
        ctx.interval, outputs = derivatives.advance(actions.detach().cpu().double().numpy())
        parts = (outputs.stock, outputs.circularity, outputs.levels, outputs.observation, outputs.accounts)
        return tuple(torch.tensor(part) for part in parts)

    @staticmethod
    def backward(ctx: Any, *adjoints: Tensor) -> Any:
        paths = np.zeros_like(ctx.interval.before.disturbances)
        outputs = Outputs(*(adjoint.numpy().copy() for adjoint in adjoints))
        stock, actions, _ = ctx.derivatives.pull_back(ctx.interval, outputs, paths)
        return None, torch.tensor(stock), torch.tensor(actions, dtype=ctx.dtype), torch.tensor(paths)
