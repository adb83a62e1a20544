"""What TorchRL costs: its collector over our own loop, with the same copies, threads and policy.

``python -m benchmarks.peers.adapter_speed`` installs TorchRL in its environment if it is not there and prints a table.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable

NETWORK = "copper_net"
COPIES = (64, 256, 1024)
ROUNDS = 7
GOAL = 0.9
HEAD = ("copies", "our loop, steps/s", "TorchRL, steps/s", "ratio", f"goal: ≥ {GOAL:g}")


def measured(copies: int) -> tuple[float, float, float]:
    """Return environment steps per processor second of our loop and of the collector, and the median of ratios."""
    import torch
    from tensordict.nn import TensorDictModule
    from torch import nn
    from torchrl.collectors import Collector
    from torchrl.modules import MultiAgentMLP

    from cirl_marl import MultiAgentVectorEnv
    from cirl_marl.adapters.torchrl import GROUP, TorchRLEnv

    torch.set_num_threads(1)
    env = TorchRLEnv(NETWORK, num_envs=copies, seed=0)
    _, agents, entries = env.observation_spec[GROUP, "observation"].shape
    layers = MultiAgentMLP(entries, 1, agents, centralized=False, share_params=False, num_cells=(64, 64))
    network = nn.Sequential(layers, nn.Tanh())
    policy = TensorDictModule(network, in_keys=[(GROUP, "observation")], out_keys=[(GROUP, "action")])
    ours = MultiAgentVectorEnv(NETWORK, num_envs=copies)
    horizon = ours.network.episode.horizon
    collector = Collector(
        env,
        policy,
        frames_per_batch=copies * horizon,
        total_frames=-1,
        device="cpu",
        auto_register_policy_transforms=False,
    )
    batches = iter(collector)

    @torch.no_grad()
    def own_loop() -> None:
        """Go through an episode, and keep what a learner needs of it, in the arrays that the policy takes."""
        observations = ours.observations()
        kept = []
        for _ in range(horizon):
            seen = torch.zeros(copies, agents, entries)
            for place, observation in enumerate(observations.values()):
                seen[:, place, : observation.shape[1]] = torch.from_numpy(observation)
            actions = network(seen)
            columns = actions.numpy()
            observations, rewards, _, truncated, _ = ours.step(
                {agent: columns[:, place] for place, agent in enumerate(ours.agents)}
            )
            paid = torch.stack([torch.from_numpy(reward).float() for reward in rewards.values()], dim=1)
            kept.append((seen, actions, paid, torch.from_numpy(truncated[ours.agents[0]].copy())))
        for column in zip(*kept, strict=True):
            torch.stack(column, dim=1)

    def torchrl() -> None:
        next(batches)

    ours.reset(seed=0)
    rounds = [(_seconds(own_loop), _seconds(torchrl)) for _ in range(ROUNDS + 1)][1:]  # the first one warms up
    collector.shutdown()
    rates = [copies * horizon / min(column) for column in zip(*rounds, strict=True)]
    return rates[0], rates[1], statistics.median(own / theirs for own, theirs in rounds)


def _seconds(act: Callable[[], None]) -> float:
    """Return the processor time that it takes."""
    began = time.process_time()
    act()
    return time.process_time() - began


def table() -> str:
    """Measure, and return the table in Markdown."""
    from benchmarks.document import markdown_table

    rows = []
    for copies in COPIES:
        own, theirs, ratio = measured(copies)
        rows.append((f"{copies:,}", f"{own:,.0f}", f"{theirs:,.0f}", f"{ratio:.2f}", "yes" if ratio >= GOAL else "no"))
    return markdown_table(HEAD, rows)


def main() -> None:
    """Measure in TorchRL's environment."""
    try:
        import torchrl  # noqa: F401
    except ModuleNotFoundError:
        from benchmarks.peers.contenders import CONTENDERS
        from benchmarks.peers.installing import python_of

        python = str(python_of(CONTENDERS["torchrl"]))
        raise SystemExit(subprocess.call([python, "-m", "benchmarks.peers.adapter_speed"])) from None
    sys.stdout.write(table() + "\n")


if __name__ == "__main__":
    main()
