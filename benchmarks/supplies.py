"""What years cost in which supplies make up for services, in an earlier tree and in this one, episodes in turns.

``git worktree add ../earlier 1d31489``, then ``python -m benchmarks.supplies ../earlier``. Both read the network files
of the earlier tree, as those of today have other numbers.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from statistics import median
from typing import Annotated

import numpy as np
import typer

CASES = (("steel_world.toml", 24), ("steel.toml:japan", 64))
"""Network files and copies."""
EPISODES = 4
"""How many are measured."""
WORKER = """
import sys, time
import numpy as np
from cirl_marl import MultiAgentVectorEnv
network, copies = sys.argv[1], int(sys.argv[2])
env, random = MultiAgentVectorEnv(network, num_envs=copies), np.random.default_rng(0)
for _ in sys.stdin:
    env.reset(seed=0)
    flows, began = [], time.process_time()
    for _ in range(env.network.episode.horizon):
        flows.append(env.advance(random.uniform(-1, 1, (len(env.agents), copies))).flow.copy())
    print(time.process_time() - began, *np.ravel(flows).tolist(), flush=True)
"""


def worker(tree: Path, network: str, copies: int) -> subprocess.Popen[str]:
    """Start a process that simulates an episode with the code of a tree for each line it reads."""
    environment = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-c", WORKER, network, str(copies)],
        cwd=tree, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


def episode(process: subprocess.Popen[str]) -> tuple[float, np.ndarray]:
    """Return processor seconds and flows of the next episode of a worker."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    seconds, *flows = map(float, process.stdout.readline().split())
    return seconds, np.array(flows)


def main(earlier: Annotated[Path, typer.Argument(help="A worktree of the earlier commit.", exists=True)]) -> None:
    """Print what episodes cost there / here, and by how much flows differ, in parts of the largest."""
    trees = earlier.resolve(), Path(__file__).resolve().parent.parent
    for name, copies in CASES:
        processes = [worker(tree, str(trees[0] / "envs" / name), copies) for tree in trees]
        ratios, apart = [], 0.0
        for _ in range(EPISODES):
            (before, flows), (now, flows_now) = map(episode, processes)
            ratios.append(before / now)
            apart = max(apart, float(np.abs(flows - flows_now).max() / np.abs(flows).max()))
        for process in processes:
            process.communicate()
        typer.echo(f"{name}, {copies} copies: {median(ratios):.1f} ×, flows {apart:.1e} apart")


if __name__ == "__main__":
    typer.run(main)
