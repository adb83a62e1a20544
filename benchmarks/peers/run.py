"""Independent PPO of other libraries on copper_net, against ours: how fast, and how soon near the bound.

``python -m benchmarks.peers.run`` installs each peer in an environment of its own, trains what is missing, and writes
the tables of benchmarks/README.md. It can be stopped and started again: records of trainings are kept.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from benchmarks.document import write_sections
from benchmarks.peers.contenders import CONTENDERS, Contender
from benchmarks.peers.gaps import Reference
from benchmarks.peers.installing import HOME, ROOT, python_of
from benchmarks.peers.settings import NETWORK
from benchmarks.peers.tables import OURS, figures, gap_table, speed_table, verdict
from benchmarks.peers.watch import Record
from cirl_marl import load_network
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, unknown_name
from cirl_marl.records.files import write_json
from cirl_marl.records.machine import processor

DOCUMENT = ROOT / "benchmarks" / "README.md"
RESULTS = ROOT / "benchmarks" / "results" / "peers.json"
SEED = 300
"""Of the trainings whose policies are judged: a seed of the study, by which nothing was tuned."""
EVERY = 12
"""Seconds of the processor after which a policy is judged."""
RECIPES = ("independent_ppo", "independent_ars", "serving_ars")
"""Whose speed says nothing about peers."""
LOCKSTEP = "lockstep"
"""Learns what the stacked do, up to rounding, and so is not judged."""
BATCHED = ("benchmarl", "torchrl")
"""Peers that step our batched environment."""
console = Console()


def main(
    only: Annotated[list[str] | None, typer.Option(help="Contenders that train; default: all.")] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of the measurement of speed.")] = 3,
    seconds: Annotated[
        float, typer.Option(min=1, help="Of the processor in a round, for two rollouts or more.")
    ] = 10.0,
    minutes: Annotated[float, typer.Option(min=0.1, help="Of the processor in which to come near the bound.")] = 2.0,
    table: Annotated[bool, typer.Option("--table", help="Train nothing: write the tables of what is there.")] = False,
    records: Annotated[Path, typer.Option(help="Where the trainings are recorded.")] = HOME / "records",
) -> None:
    """Install, train what is missing, and write figures and tables."""
    for name in only or ():
        if name not in CONTENDERS:
            raise CirlError(unknown_name("contender", name, CONTENDERS))
    chosen = only or list(CONTENDERS)
    fast = [name for name in chosen if name not in RECIPES]
    if not table:
        records.mkdir(parents=True, exist_ok=True)
        for turn in range(rounds):
            for name in fast:
                _train(name, records / f"speed-{name}-{turn}.json", seconds, 0, turn)
        for name in (name for name in chosen if name != LOCKSTEP):
            _train(name, records / f"gap-{name}.json", 60 * minutes, EVERY, SEED)
    _write(records, chosen)


def _train(name: str, out: Path, seconds: float, every: float, seed: int) -> None:
    """Train in a process of its own, unless it is done; what it prints is kept beside the record."""
    if out.is_file():
        return
    contender = CONTENDERS[name]
    python = python_of(contender)
    console.print(f"{out.stem}: {contender.title}, {seconds:g} s")
    asked = {"seconds": seconds, "every": every, "seed": seed, "threads": contender.threads, "envs": contender.envs}
    options = [text for key, value in asked.items() for text in (f"--{key}", f"{value:g}")]
    with out.with_suffix(".log").open("w", encoding="utf-8") as log:
        subprocess.run(
            [str(python), "-m", "benchmarks.peers.work", name, str(out), *options],
            cwd=ROOT,
            env=_surroundings(contender),
            stdout=log,
            stderr=subprocess.STDOUT,
            check=True,
        )


def _surroundings(contender: Contender) -> dict[str, str]:
    threads = str(contender.threads)
    return {**os.environ, "OMP_NUM_THREADS": threads, "PYTHONPATH": str(ROOT), "RAY_USAGE_STATS_ENABLED": "0"}


def _write(records: Path, chosen: Sequence[str]) -> None:
    """Write figures and tables of what is there, and name what is not."""
    found = {name: [Record.read(path) for path in sorted(records.glob(f"speed-{name}-[0-9]*.json"))] for name in chosen}
    speed = {name: rounds for name, rounds in found.items() if rounds}
    trained = {name: Record.read(path) for name in chosen if (path := records / f"gap-{name}.json").is_file()}
    if OURS not in speed or not any(CONTENDERS[name].peer for name in speed):
        raise CirlError(f"{records}: no tables without the speed of '{OURS}' and of a peer")
    reference = Reference.solved()
    standings = {name: [reference.standing(each) for each in record.judged] for name, record in trained.items()}
    setups = {name: record.setup for name, record in trained.items()}
    write_json(RESULTS, {"processor": processor(), **figures(speed, standings, setups)})
    agents = len(MultiAgentVectorEnv(load_network(NETWORK), num_envs=1).agents)
    peers = [name for name in speed if CONTENDERS[name].peer]
    groups = {"With": [name for name in peers if name in BATCHED], "Without": [n for n in peers if n not in BATCHED]}
    said = [f"{how} our batched environment: {verdict(speed, names)}." for how, names in groups.items() if names]
    said += _lacking("rate", [name for name in CONTENDERS if name not in speed and name not in RECIPES])
    tables = {
        "peers_speed": "\n\n".join([speed_table(speed, agents), " ".join(said)]),
        "peers_gap": "\n\n".join(
            [gap_table(standings), *_lacking("training", [n for n in CONTENDERS if n not in (*trained, LOCKSTEP)])]
        ),
    }
    write_sections(DOCUMENT, tables)


def _lacking(what: str, names: Sequence[str]) -> list[str]:
    return [f"No {what} of {', '.join(CONTENDERS[name].title for name in names)} is recorded."] if names else []


if __name__ == "__main__":
    typer.run(main)
