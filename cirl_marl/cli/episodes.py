"""``cirl simulate | plan``: what a controller or policy does in one episode."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cirl_marl.cli.common import MinService, NetworkName, Scenario, StartSeed, app, bar, console, say, stem
from cirl_marl.controllers import Controller
from cirl_marl.controllers.basic import Watched
from cirl_marl.controllers.rollout import Beginning, Rollout, beginning, rollout
from cirl_marl.controllers.shortages import shortages
from cirl_marl.definitions.catalogue import file_and_region, networks
from cirl_marl.environments.vector import VectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.evaluation.figures import time_window
from cirl_marl.network import Network
from cirl_marl.optimum.named import CONTROLLERS, SETTABLE, named_controller


@app.command()
def simulate(
    network: NetworkName,
    control: Annotated[str, typer.Option(help=f"Who acts: {', '.join(CONTROLLERS)}.")] = "neutral",
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="AGENT=VALUE in [-1, 1], held constant under --control constant or scripted; repeatable."
        ),
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Control intervals; default: the horizon.")] = None,
    seed: StartSeed = None,
    scenario: Scenario = None,
    out: Annotated[Path | None, typer.Option(help="Directory of CSV and picture; default: here.")] = None,
) -> None:
    """Simulate a network under a controller without learning; write a CSV and a picture.

    Flows, and λ beside them in the picture, are means over each interval; the CSV has λ at its end as well.
    """
    from cirl_marl.report.trajectory import write_trajectory

    controller = named_controller(control, held=_held(control, set_ or []))
    env = VectorEnv(network, num_envs=1, scenario=scenario, horizon=steps)
    found, begun = env.network, beginning(env, seed)
    with bar("simulating") as progress:
        watched = Watched(controller, progress)
        run = rollout(env, watched, seed=begun.seed, start=begun.given, progress=watched.acted)
    title = f"{found.title or found.name}, {control} control"
    written = write_trajectory(out or Path(), stem(found, control), env, begun, run, title)
    _say_figures(run, found, begun)
    say(f"wrote {' and '.join(map(str, written))}")


@app.command()
def plan(
    source: Annotated[
        str, typer.Argument(metavar="RUN | NETWORK", help="Training run; or with --control a network, as elsewhere.")
    ],
    control: Annotated[
        str | None, typer.Option(help=f"Who acts in a network: {', '.join(CONTROLLERS)}; a run acts by its policies.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="CSV file to write; default: plan_NETWORK[_SCENARIO]_CONTROL or plan_RUN."),
    ] = None,
    scenario: Scenario = None,
    seed: StartSeed = None,
    min_service: MinService = None,
) -> None:
    """Write what a policy or controller does in one episode: its actions in physical units over time, as CSV.

    A row is a control interval: when it begins and ends (if the network has a start on the calendar with the year or
    date on which it begins), the value of every control (a flow ordered, a factor on what a valve lets through, or an
    input of a model) with its unit, the resulting flows, circularity and service level.
    """
    from cirl_marl.controllers.schedule import schedule

    if out is not None and out.suffix != ".csv":
        raise CirlError(f"--out {out}: needs the name of a .csv file")
    env, controller = _actor(source, control, scenario, min_service)
    who = Path(source).resolve().name if control is None else stem(env.network, control)
    path = Path(f"plan_{who}.csv") if out is None else out
    with bar("planning") as progress:
        watched = Watched(controller, progress)
        found = schedule(env, watched, seed=seed, progress=watched.acted)
    path.parent.mkdir(parents=True, exist_ok=True)
    found.write(path)
    _say_figures(found.rollout, env.network, found.begun)
    if controller.note:
        say(controller.note)
    say(f"wrote {path}")


def _actor(
    source: str, control: str | None, scenario: str | None, min_service: float | None
) -> tuple[VectorEnv, Controller]:
    if control is not None and (Path(source) / "config.json").is_file():
        raise CirlError(f"plan {source}: is a training run, which acts by its policies; leave out --control")
    if control is not None:
        return VectorEnv(source, num_envs=1, scenario=scenario), named_controller(control, min_service=min_service)
    if source in networks() or file_and_region(source):
        raise CirlError(f"plan {source}: which control? --control {'|'.join(CONTROLLERS)}; only a run has policies")
    if scenario is not None or min_service is not None:
        raise CirlError("--scenario and --min-service go with --control; a run has its own scenario and policies")
    from cirl_marl.learners.run import RunDirectory
    from cirl_marl.learners.trained import Trained

    run = RunDirectory(source)
    return run.make_env(1), Trained(run)


def _say_figures(run: Rollout, network: Network, begun: Beginning) -> None:
    """Say where an episode began, what came of it, and which flows were less than was asked for."""
    say(f"start: {begun.said}")
    figures = [
        f"λ̄ = {float(run.episode_circularity[0]):.5g} {network.mass_unit}",
        f"service level {float(run.episode_service[0]):.4f}",
    ]
    if network.objective.criticality is not None:
        figures.append(f"time-window circularity {float(time_window(network, run)[0]):.5g} {network.mass_unit}")
    console.print(", ".join(figures))
    if len(network.services) > 1:
        each = zip(network.services, run.episode_levels[0].tolist(), strict=True)
        say(f"service levels: {', '.join(f'{service.id} {level:.4f}' for service, level in each)}")
    for short in shortages(run, network):
        say(short.said)


def _held(control: str, settings: list[str]) -> dict[str, float]:
    """Return the values of --set by agent."""
    if settings and control not in SETTABLE:
        raise CirlError(f"--set goes with --control constant or scripted, not with {control}")
    held = {}
    for setting in settings:
        agent, _, value = setting.partition("=")
        try:
            held[agent] = float(value)
        except ValueError:
            raise CirlError(f"--set {setting}: needs AGENT=VALUE with a number in [-1, 1]") from None
    return held
