"""``cirl demo``: a team trained, compared and shown in the browser, in a few minutes."""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from cirl_marl.cli.common import LEARNERS, app, folder_for, say, training_bar
from cirl_marl.cli.learning import evaluate_and_draw, what_is_kept
from cirl_marl.errors import CirlError

NETWORK, RECIPE, STEPS = "copper_net", "exact_gradients", 600_000
COMPARISON_EPISODES = 16
"""Episodes in which the team is held against the bound."""
PAGE = "report.html"


@app.command(rich_help_panel=LEARNERS)
def demo(
    out: Annotated[Path, typer.Option(help="Run directory; one of this demo is taken up where it was left.")] = Path(
        "runs/demo"
    ),
    steps: Annotated[int, typer.Option(min=1, help="Environment steps of the training.")] = STEPS,
    opens: Annotated[bool, typer.Option("--open/--no-open", help="Whether to open the report in the browser.")] = True,
) -> None:
    """Train the sixteen agents of the copper network for a few minutes, compare them, and open the report.

    Ctrl-C saves what was learnt; the same command goes on. Without a display the path of the report is printed alone.
    """
    try:
        _train(folder_for(out, "--out"), steps)
    except KeyboardInterrupt:
        say(f"\nstopped; {what_is_kept(out)}")
        raise typer.Exit(130) from None
    page = out / PAGE
    evaluate_and_draw(out, COMPARISON_EPISODES, 0, page)
    is_open = opens and has_display() and webbrowser.open(page.resolve().as_uri())
    say(f"report: {page.resolve()}" + ("" if is_open else "  (open it in a browser; it needs no server)"))


def _train(out: Path, steps: int) -> None:
    """Train the team, or what is left of that."""
    from cirl_marl.definitions.catalogue import load_network
    from cirl_marl.learners.interface import complete_run
    from cirl_marl.learners.recipe import load_recipe
    from cirl_marl.learners.run_directory import RunDirectory

    if (out / "config.json").is_file():
        run = RunDirectory(out)
        contents = (run.network().name, run.config.recipe.name)
        if contents != (load_network(NETWORK).name, RECIPE):
            raise CirlError(
                f"--out {out}: is a run of {contents[1]} in {contents[0]}, not of the demo; choose another folder"
            )
        if run.status["state"] == "complete":
            say(f"{out} is trained already; remove it to begin anew")
    with training_bar() as report:
        complete_run(out, NETWORK, load_recipe(RECIPE), steps=steps, seed=0, report=report)


def has_display() -> bool:
    """Whether a window can be opened; a browser of the terminal is none."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
