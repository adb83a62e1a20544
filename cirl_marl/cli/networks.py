"""``cirl networks | show | check | simulate | plan``: networks without learning."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from cirl_marl.cli.common import MinService, NetworkName, Scenario, Seed, app, bar, console, errors, plain, say
from cirl_marl.controllers import Controller
from cirl_marl.controllers.basic import Watched
from cirl_marl.controllers.rollout import Rollout, interval_ends, rollout
from cirl_marl.definitions.catalogue import file_and_region, load_network, networks, recipes
from cirl_marl.definitions.reading import DEFAULT, Definition
from cirl_marl.environments.vector import VectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.evaluation.figures import time_window
from cirl_marl.network import Network
from cirl_marl.network.calendar import labels
from cirl_marl.network.series import extremes
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
    picture: Annotated[Path | None, typer.Option(help="Where to draw it; default: NETWORK.png here.")] = None,
) -> None:
    """Show the compartments, flows and circularity of a network at its start state, and draw it."""
    from cirl_marl.drawing.digraph import save_network
    from cirl_marl.report.tables import arcs_table, nodes_table

    found = load_network(network, scenario=scenario)
    env = VectorEnv(found, num_envs=1)
    middle = {node.id: stock for node, stock in zip(found.stores, found.initial.mean(axis=0).tolist(), strict=True)}
    env.reset(seed=0, options={"initial_state": middle})
    stock, flow = env.physical.stock[env.rows.nodes, 0], env.physical.flow[:, 0]
    console.print(nodes_table(found, stock))
    console.print(arcs_table(found, flow))
    for service in found.services:
        ends = [f"at least {service.low:g}"] if extremes(service.low)[1] > 0 else []
        ends += [] if np.isinf(extremes(service.high)[0]) else [f"at most {service.high:g}"]
        console.print(
            f"service '{service.id}': {service.measure or service.quantity} of {service.provider} {' and '.join(ends)}"
        )
    circularity = float(found.circularity(flow))
    console.print(f"λ of the start state: {circularity:.5g} {found.mass_unit}")
    path = picture or Path(f"{found.name}.png")
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
    for source in sources:
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
    seed: Seed = 0,
    scenario: Scenario = None,
    out: Annotated[Path | None, typer.Option(help="Directory of CSV and picture; default: here.")] = None,
) -> None:
    """Simulate a network under a controller without learning; write a CSV and a picture."""
    from cirl_marl.report.curves import save_trajectory

    controller = named_controller(control, held=_held(control, set_ or []))
    env = VectorEnv(network, num_envs=1, scenario=scenario, horizon=steps)
    found = env.network
    with bar("simulating") as progress:
        watched = Watched(controller, progress)
        run = rollout(env, watched, seed=seed, progress=watched.acted)
    folder = out or Path()
    folder.mkdir(parents=True, exist_ok=True)
    name = _called(found, control)
    time = interval_ends(found)
    env.reset(seed=seed)  # to where the episode began
    began = env.physical
    _write_csv(folder / f"{name}.csv", env, time, run)
    save_trajectory(
        folder / f"{name}.png",
        found,
        time,
        run.stock.T,
        run.flow.T,
        run.circularity[0],
        start=np.concatenate([began.stock[env.rows.nodes, 0], env.dynamics.batches.loads(began.stock)[:, 0]]),
        load=run.load.T,
        service=run.service[0] if found.services else None,
        title=f"{found.title or found.name}, {control} control",
    )
    _say_figures(run, found)
    console.print(f"wrote {folder / name}.csv and {folder / name}.png")


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
    seed: Annotated[
        int | None, typer.Option(min=0, help="Start as the first episode of this evaluation; default: mid-range.")
    ] = None,
    min_service: MinService = None,
) -> None:
    """Write what a policy or controller does in one episode: its actions in physical units over time, as CSV.

    A row is a control interval: when it begins and ends, the year or date on which it begins if the network has a
    start on the calendar, the value of every control (a flow ordered, a factor on what a
    valve lets through, or an input of a model) with its unit, the resulting flows, circularity and service level.
    """
    from cirl_marl.controllers.schedule import schedule

    if out is not None and out.suffix != ".csv":
        raise CirlError(f"--out {out}: needs the name of a .csv file")
    env, controller = _actor(source, control, scenario, min_service)
    who = Path(source).resolve().name if control is None else _called(env.network, control)
    path = Path(f"plan_{who}.csv") if out is None else out
    with bar("planning") as progress:
        watched = Watched(controller, progress)
        found = schedule(env, watched, seed=seed, progress=watched.acted)
    path.parent.mkdir(parents=True, exist_ok=True)
    found.write(path)
    _say_figures(found.rollout, env.network)
    if controller.note:
        say(controller.note)
    say(f"wrote {path}")


def _called(network: Network, control: str) -> str:
    """Return the stem of a file of ``control`` in a network, so that no scenario takes the place of another."""
    scenario = [] if network.scenario_name == DEFAULT else [network.scenario_name]
    return "_".join([network.name, *scenario, control])


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


def _say_figures(run: Rollout, network: Network) -> None:
    figures = [
        f"λ̄ = {float(run.episode_circularity[0]):.5g} {network.mass_unit}",
        f"service level {float(run.episode_service[0]):.4f}",
    ]
    if network.objective.criticality is not None:
        figures.append(f"time-window circularity {float(time_window(network, run)[0]):.5g} {network.mass_unit}")
    console.print(", ".join(figures))


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


def _write_csv(path: Path, env: VectorEnv, time: np.ndarray, run: Rollout) -> None:
    """Write the state in which ``env`` is, from which ``run`` began, and a row for the end of each interval."""
    from cirl_marl.records.files import write_atomically

    network, physics = env.network, env.dynamics.inner
    calendar, dates = labels(network, np.concatenate([[0.0], time]))
    header = [f"time ({network.time_unit})", *calendar, f"circularity ({network.mass_unit})", "service level"]
    header += [f"stock of {node.id} ({network.mass_unit})" for node in network.stores]
    header += [f"flow of {arc.id} ({network.mass_unit}/{network.time_unit})" for arc in network.arcs]
    passing = network.nodes[len(network.stores) :]
    header += [f"throughput of {node.id} ({network.mass_unit}/{network.time_unit})" for node in passing]
    header += [f"mass on {line.id} ({network.mass_unit})" for line in env.dynamics.batches.lines]
    header += [physics.names[row] for row in physics.visible]
    start = env.physical
    held = [*start.stock[env.rows.nodes, 0].tolist(), *[""] * (len(network.arcs) + len(passing))]
    held += [*env.dynamics.batches.loads(start.stock)[:, 0].tolist(), *start.inner[physics.visible, 0].tolist()]

    through = network.throughput(run.flow.T)
    held_at = (*run.stock.T, *run.flow.T, *through, *run.load.T, *run.inner.T)
    measured = [column.tolist() for column in (run.circularity[0], run.service[0], *held_at)]
    columns = [time.tolist(), *(each[1:] for each in dates), *measured]

    def write(target: Path) -> None:
        with target.open("w", newline="") as file:
            begin = [0.0, *(each[0] for each in dates), "", "", *held]
            csv.writer(file).writerows([header, begin, *zip(*columns, strict=True)])

    write_atomically(path, write)
