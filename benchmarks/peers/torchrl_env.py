"""Our batched environment for TorchRL and BenchMARL, which is built on it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from benchmarks.peers.problem import Copies, Scaling

GROUP = "agents"


class CopiesEnv(EnvBase):  # type: ignore[misc]
    """All agents in one group, so that networks of all are evaluated at once; all copies in one step."""

    def __init__(self, copies: int, seed: int, scaling: Scaling) -> None:
        """Begin ``copies`` episodes."""
        super().__init__(device="cpu", batch_size=torch.Size([copies]))
        self._copies = Copies(copies, seed, scaling)
        batch, agents, entries = self._copies.shape
        flag, shape = Binary(n=1, shape=(batch, 1), dtype=torch.bool), (batch, agents)
        self.observation_spec = _of_group("observation", Unbounded((*shape, entries)), shape)
        self.action_spec = _of_group("action", Bounded(-1.0, 1.0, (*shape, 1), dtype=torch.float32), shape)
        self.reward_spec = _of_group("reward", Unbounded((*shape, 1)), shape)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), shape=(batch,))

    def _reset(self, tensordict: Any = None, **_: Any) -> Any:
        if tensordict is not None and (asked := tensordict.get("_reset", None)) is not None and not asked.all():
            raise ValueError("all copies begin anew together")
        return self._seen(self._copies.observation, over=False)

    def _step(self, tensordict: Any) -> Any:
        actions = tensordict[GROUP, "action"].numpy()
        last, rewards, over = self._copies.step(actions)
        outcome = self._seen(last, over=over)
        outcome[GROUP, "reward"] = torch.as_tensor(rewards)[..., None]
        return outcome

    def _seen(self, observation: Any, *, over: bool) -> Any:
        """Return observations; an episode that is over is terminated, as nothing is expected after it."""
        batch, agents, _ = self._copies.shape
        group = TensorDict({"observation": torch.as_tensor(observation)}, batch_size=(batch, agents))
        flag = torch.full((batch, 1), over)
        return TensorDict({GROUP: group, "done": flag, "terminated": flag.clone()}, batch_size=(batch,))

    def _set_seed(self, seed: int | None) -> None:
        """Leave the streams of the copies, which have their seeds."""


def _of_group(name: str, spec: Any, shape: tuple[int, ...]) -> Any:
    return Composite({GROUP: Composite({name: spec}, shape=shape)}, shape=shape[:1])
