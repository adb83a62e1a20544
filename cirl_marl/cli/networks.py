"""``cirl networks | show | check | simulate | plan``: networks without learning."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from cirl_marl.cli.common import (
    MinService,
    NetworkName,
    Scenario,
    StartSeed,
    app,
    bar,
    console,
    errors,
    plain,
    say,
    stem,
)
from cirl_marl.controllers import Controller
from cirl_marl.controllers.basic import Watched
from cirl_marl.controllers.rollout import Beginning, Rollout, beginning, rollout
from cirl_marl.controllers.shortages import shortages
from cirl_marl.definitions.catalogue import file_and_region, load_network, networks, recipes
from cirl_marl.definitions.reading import Definition
from cirl_marl.environments.vector import VectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.evaluation.figures import time_window
from cirl_marl.network import Network
from cirl_marl.network.series import Series, extremes
from cirl_marl.optimum.named import CONTROLLERS, SETTABLE, named_controller

if TYPE_CHECKING:
    from cirl_marl.learners import Recipe


@app.command("networks")
def list_networks() -> None:
    """List the networks and the learner recipes of the catalogue."""
    from cirl_marl.report.tables import networks_table

    console.print(networks_table({name: load_network(name) for name in networks()}))
    console.print(f"recipes for --recipe: {', '.join(recipes())}")


@app.command()
def show(
    network: NetworkName,
    scenario: Scenario = None,
    seed: StartSeed = None,
    picture: Annotated[
        Path | None, typer.Option(help="Where to draw it; default: NETWORK[_SCENARIO].png here.")
    ] = None,
) -> None:
    """Show the compartments, flows and circularity of a network at its start state, and draw it."""
    from cirl_marl.drawing.digraph import save_network
    from cirl_marl.report.tables import arcs_table, nodes_table

    found = load_network(network, scenario=scenario)
    env = VectorEnv(found, num_envs=1)
    begun = beginning(env, seed)
    begun.reset(env)
    stock, flow = env.rows.stocks(env.physical.stock)[:, 0], env.physical.flow[:, 0]
    console.print(nodes_table(found, stock))
    console.print(arcs_table(found, flow))
    for service in found.services:
        ends = [f"at least {service.low:g}"] if extremes(service.low)[1] > 0 else []
        ends += [] if np.isinf(extremes(service.high)[0]) else [f"at most {service.high:g}"]
        changing = ", changing in time" if isinstance(service.low, Series) or isinstance(service.high, Series) else ""
        measured = f"{service.measure or service.quantity} of {service.provider}"
        console.print(f"service '{service.id}': {measured} {' and '.join(ends)}{changing}")
    circularity = float(found.circularity(flow))
    console.print(f"λ of the start state: {circularity:.5g} {found.mass_unit}")
    say(f"start: {begun.said}")
    path = picture or Path(f"{stem(found)}.png")
    if path.suffix != ".png":
        raise CirlError(f"--picture {path}: needs the name of a .png file")
    save_network(path, found, stock, flow, title=found.title, circularity=circularity)
    console.print(f"picture: {path}")


@app.command()
def check(
    sources: Annotated[
        list[str], typer.Argument(metavar="FILE...", help="Networks and recipes: files, or names of the catalogue.")
    ],
    network: Annotated[
        str | None, typer.Option(help="Check that recipes fit this network too: scenario, agents, matches, algorithms.")
    ] = None,
) -> None:
    """Check networks and recipes and name every mistake; exit code 2 if there is one.

    What is no mistake but seldom meant is said as a remark. Nothing is trained.
    """
    faulty = False
    for source in [each for given in sources for each in _with_regions(given)]:
        try:
            if _is_recipe(source):
                _check_recipe(source, network)
            elif network is None:
                _check_network(source)
            else:
                raise CirlError(f"check {source}: is no recipe; --network names the network that recipes must fit")
        except CirlError as error:
            faulty = True
            errors.print(plain(error), highlight=False, soft_wrap=True)
    if faulty:
        raise typer.Exit(2)


def _with_regions(source: str) -> list[str]:
    """Return a file as it is, or once for each region that it has."""
    from cirl_marl.definitions.reading import read_toml

    try:
        regions = read_toml(Path(source)).get("regions") if source.endswith(".toml") else None
    except CirlError:  # a mistake of the file, which the check says
        return [source]
    return [f"{source}:{region}" for region in regions] if isinstance(regions, dict) and regions else [source]


def _is_recipe(source: str) -> bool:
    """Whether a file says how to learn, or a name is that of a recipe."""
    from cirl_marl.definitions.reading import read_toml

    if not source.endswith(".toml"):
        return source in recipes()
    return bool({"learner", "run", "match"} & set(read_toml(Path(source))))


def _check_recipe(source: str, network: str | None) -> None:
    from cirl_marl.learners.recipe import load_recipe

    recipe = load_recipe(source)
    idle = [] if network is None else _idle_matches(source, recipe, load_network(network))
    algorithms = ", ".join(dict.fromkeys(learner.algorithm for _, learner in recipe.learners()))
    fit = "" if network is None else f", in {network}"
    say(f"{source}: recipe of {algorithms}, {recipe.run.steps:,} steps in {recipe.run.envs} copies{fit}: no mistakes")
    for match in idle:
        say(f"{source}: remark on {network}: nobody learns by {match}")


def _idle_matches(source: str, recipe: Recipe, network: Network) -> list[str]:
    """Prepare a training, as far as it goes without training, and return the matches by which nobody learns."""
    from cirl_marl.learners.launch import prepared

    try:
        learners = prepared(network, recipe).learners.values()
    except CirlError as error:
        raise CirlError(f"{source} in {network.name}: {error}") from error
    busy = {id(learner.spec) for learner in learners}
    return [where for where, learner in recipe.learners()[1:] if id(learner) not in busy]


def _check_network(source: str) -> None:
    from cirl_marl.controllers.remarks import remarks

    network = load_network(source)
    assert network.source is not None
    Definition(network.source).check(network.region)
    for each in (network, *network.scenarios.values()):
        try:
            VectorEnv(each, num_envs=1)  # finds what only a network that is run says, as rates no solver can follow
        except CirlError as error:
            raise CirlError(f"{source}, scenario '{each.scenario_name}': {error}") from error
    say(
        f"{source}: {len(network.compartments)} compartments, {len(network.agents)} agents, "
        f"scenarios {', '.join([network.scenario_name, *network.scenarios])}: no mistakes"
    )
    for each in (network, *network.scenarios.values()):
        for remark in remarks(each):
            say(f"{source}: remark on scenario '{each.scenario_name}': {remark}")


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
