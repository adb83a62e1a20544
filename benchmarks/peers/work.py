"""One training of one contender, in the environment in which it is installed.

``python -m benchmarks.peers.work torchrl record.json --seconds 30`` writes what ``watch.Record`` says.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.peers.contenders import CONTENDERS
from benchmarks.peers.problem import measured_scaling
from benchmarks.peers.settings import SETTINGS
from benchmarks.peers.watch import Watch
from cirl_marl.errors import CirlError, unknown_name


def main(
    contender: Annotated[str, typer.Argument(help="One of contenders.CONTENDERS.")],
    out: Annotated[Path, typer.Argument(help="File of the record.")],
    seconds: Annotated[float, typer.Option(min=0, help="Seconds of training, of the processor.")] = 30.0,
    every: Annotated[float, typer.Option(min=0, help="Seconds after which a policy is judged; 0: never.")] = 0.0,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    envs: Annotated[int, typer.Option(min=1, help="Copies of the environment.")] = SETTINGS.envs,
    threads: Annotated[int, typer.Option(min=1, help="Threads, or for RLlib processes that sample.")] = 1,
) -> None:
    """Train, and write what happened."""
    if contender not in CONTENDERS:
        raise CirlError(unknown_name("contender", contender, CONTENDERS))
    watch = Watch(contender, seconds, every)
    scaling = measured_scaling()
    home, train = CONTENDERS[contender].code
    getattr(importlib.import_module(f"benchmarks.peers.{home}"), train)(watch, seed, scaling, envs, threads)
    watch.record.load.append(os.getloadavg()[0])
    watch.record.write(out)


if __name__ == "__main__":
    typer.run(main)
