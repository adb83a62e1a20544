"""The command line, ``cirl``; each module holds a few commands."""

from __future__ import annotations

import gc
import io
import sys

from cirl_marl.cli import (  # noqa: F401
    benchmarking,
    comparing,
    demonstration,
    episodes,
    explaining,
    importing,
    learning,
    networks,
    sweeping,
)
from cirl_marl.cli.common import app, errors, plain
from cirl_marl.errors import CirlError, LearnerError

__all__ = ["app", "main"]


def main() -> None:
    """Run the command line; input that cannot be used ends it with exit code 2, a failed learner with 1."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # not every locale has a λ
    gc.set_threshold(200_000)  # most of what a command makes lasts: to look through it again and again takes long
    try:
        app()
    except (CirlError, OSError) as error:
        errors.print(f"[bold red]error:[/] {plain(error)}", highlight=False, soft_wrap=True)
        sys.exit(2)
    except LearnerError as error:
        errors.print(f"[bold red]training failed:[/] {plain(error)}", highlight=False, soft_wrap=True)
        sys.exit(1)
    except KeyboardInterrupt:  # before a command has begun, which else says what is kept
        sys.exit(130)
