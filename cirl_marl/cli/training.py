"""The command line: ``cirl networks | show | check | simulate | train | evaluate | report | paper``."""

from __future__ import annotations

import csv
import sys
import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from cirl_marl.catalogue import load_network, networks, recipes
from cirl_marl.controllers import LQR, Constant, Controller, Random, Scripted
from cirl_marl.errors import CirlError, DefinitionError, LearnerError, unknown
from cirl_marl.evaluate import Rollout, interval_ends, rollout
from cirl_marl.vector_env import VectorEnv

app = typer.Typer(
    help="Material networks whose compartments learn to raise circularity.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
console = Console(width=None if sys.stdout.isatty() else 140)
errors = Console(stderr=True)

NetworkName = Annotated[str, typer.Argument(metavar="NETWORK", help="Name in the catalogue, or a .toml file.")]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="Directory of a training run.")]
Scenario = Annotated[str | None, typer.Option(help="Scenario of the definition; default: the physical one.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of every random stream.")]
Episodes = Annotated[int, typer.Option(min=2, help="Fresh episodes to evaluate on.")]
CONTROLS = ("neutral", "constant", "random", "scripted", "lqr")


def main() -> None:
    """Run the command line; input that cannot be used ends it with exit code 2, a failed learner with 1."""
    try:
        app()
    except CirlError as error:
        errors.print(f"[bold red]error:[/] {_plain(error)}", highlight=False, soft_wrap=True)
        sys.exit(2)
    except OSError as error:
        errors.print(f"[bold red]error:[/] {_plain(error)}", highlight=False, soft_wrap=True)
        sys.exit(2)
    except LearnerError as error:
        errors.print(f"[bold red]training failed:[/] {_plain(error)}", highlight=False, soft_wrap=True)
        sys.exit(1)


@app.command("networks")
def list_networks() -> None:
    """List the networks and the learner recipes of the catalogue."""
    from cirl_marl.report.tables import networks_table

    console.print(networks_table({name: load_network(name) for name in networks()}))
    console.print(f"recipes for --agents: {', '.join(recipes())}")


@app.command()
def show(
    network: NetworkName,
    scenario: Scenario = None,
    picture: Annotated[Path | None, typer.Option(help="Where to draw it; default: NETWORK.png here.")] = None,
) -> None:
    """Show the compartments, flows and circularity of a network at its start state, and draw it."""
    from cirl_marl.report.digraph import save_network
    from cirl_marl.report.tables import arcs_table, nodes_table

    found = load_network(network, scenario=scenario)
    env = VectorEnv(found, num_envs=1)
    middle = {node.id: sum(node.initial) / 2 for node in found.nodes}
    env.reset(seed=0, options={"initial_state": middle})
    stock, flow = env.physical.stock[: len(found.nodes), 0], env.physical.flow[:, 0]
    console.print(nodes_table(found, stock))
    console.print(arcs_table(found, flow))
    for service in found.services:
        ends = [f"at least {service.low:g}"] if service.low > 0 else []
        ends += [] if np.isinf(service.high) else [f"at most {service.high:g}"]
        console.print(
            f"service '{service.id}': {service.measure or service.quantity} of {service.provider} {' and '.join(ends)}"
        )
    console.print(f"λ of the start state: {float(found.circularity(flow)):.5g} {found.mass_unit}")
    path = picture or Path(f"{found.name}.png")
    if path.suffix != ".png" or not path.parent.is_dir():
        raise CirlError(f"--picture {path}: needs the name of a .png file in a folder that exists")
    save_network(path, found, stock, flow, title=found.title)
    console.print(f"picture: {path}")


@app.command()
def check(files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Definition files.")]) -> None:
    """Check definition files and name every mistake; exit code 2 if there is one."""
    from cirl_marl.definition import read_network

    faulty = False
    for path in files:
        try:
            network = read_network(path)
        except DefinitionError as error:
            faulty = True
            errors.print(_plain(error), highlight=False, soft_wrap=True)
        else:
            scenarios = ", ".join([network.scenario_name, *network.scenarios])
            console.print(
                f"{path}: {len(network.compartments)} compartments, {len(network.agents)} agents, "
                f"scenarios {scenarios}: no mistakes",
                soft_wrap=True,
            )
    if faulty:
        raise typer.Exit(2)


@app.command()
def simulate(
    network: NetworkName,
    control: Annotated[str, typer.Option(help=f"Who acts: {', '.join(CONTROLS)}.")] = "neutral",
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

    controller = _controller(control, set_ or [])
    env = VectorEnv(network, num_envs=1, scenario=scenario, horizon=steps)
    found = env.network
    with _bar("simulating", found.episode.horizon) as progress:
        run = rollout(env, controller, seed=seed, progress=progress)
    folder = out or Path()
    folder.mkdir(parents=True, exist_ok=True)
    name = f"{found.name}_{control}"
    time = interval_ends(found)
    _write_csv(folder / f"{name}.csv", env, time, run)
    save_trajectory(folder / f"{name}.png", found, time, run.stock.T, run.flow.T, run.circularity[0], load=run.load.T)
    console.print(
        f"λ̄ = {float(run.episode_circularity[0]):.5g} {found.mass_unit}, "
        f"service level {float(run.episode_service[0]):.4f}"
    )
    console.print(f"wrote {folder / name}.csv and {folder / name}.png")


@app.command()
def train(
    context: typer.Context,
    network: Annotated[str | None, typer.Argument(metavar="NETWORK", help="Catalogue name or .toml file.")] = None,
    agents: Annotated[str, typer.Option(help="Learner recipe: catalogue name or .toml file.")] = "independent_ppo",
    steps: Annotated[int | None, typer.Option(min=1, help="Environment steps, summed over the copies.")] = None,
    envs: Annotated[int | None, typer.Option(min=1, help="Copies of the environment.")] = None,
    seed: Seed = 0,
    scenario: Scenario = None,
    reward: Annotated[str | None, typer.Option(help="local, circularity, mixed, difference or local_sum.")] = None,
    observe: Annotated[str | None, typer.Option(help="local, neighbours or full.")] = None,
    out: Annotated[Path | None, typer.Option(help="Run directory; default: runs/NETWORK-RECIPE-seedN.")] = None,
    resume: Annotated[Path | None, typer.Option(metavar="RUN", help="Go on with an interrupted run.")] = None,
    episodes: Episodes = 64,
) -> None:
    """Train one learner per compartment, all at once, then evaluate them and draw what changed."""
    from cirl_marl import learners

    if (network is None) == (resume is None):
        raise CirlError("train needs either NETWORK or --resume RUN")
    if resume is not None:
        _only_resume(context)
    directory = resume or out or Path("runs") / f"{Path(str(network)).stem}-{Path(agents).stem}-seed{seed}"
    with _training_bar() as report:
        try:
            if resume is not None:
                training = learners.resume(resume, report=report)
            else:
                training = learners.train(
                    str(network),
                    agents,
                    directory=directory,
                    steps=steps,
                    envs=envs,
                    seed=seed,
                    scenario=scenario,
                    reward=reward,
                    observe=observe,
                    report=report,
                )
        except KeyboardInterrupt:
            console.print(f"\nstopped; everything learnt is saved. Go on with: cirl train --resume {directory}")
            raise typer.Exit(130) from None
    assert training.run is not None
    _evaluate_and_draw(training.run.path, episodes, 0)


@app.command()
def evaluate(run: RunPath, episodes: Episodes = 64, seed: Seed = 0) -> None:
    """Compare the trained policies with neutral and random control on fresh seeds never used in training."""
    from cirl_marl.learners.run import RunDirectory
    from cirl_marl.report.run import evaluate_run
    from cirl_marl.report.tables import evaluation_table, local_returns_table

    found = RunDirectory(run)
    with _bar("evaluating", 3 * found.make_env(1).network.episode.horizon) as progress:
        figures, _, _ = evaluate_run(found, episodes=episodes, seed=seed, progress=lambda _, steps: progress(None))
    console.print(evaluation_table(figures))
    console.print(local_returns_table(figures))


@app.command()
def report(run: RunPath, episodes: Episodes = 64, seed: Seed = 0) -> None:
    """Evaluate a run and draw its pictures anew."""
    _evaluate_and_draw(run, episodes, seed)


@app.command()
def paper(
    environment: Annotated[str | None, typer.Argument(metavar="ENV", help="Such as CopperNet; default: all.")] = None,
    algorithm: Annotated[str | None, typer.Argument(metavar="ALGORITHM", help="Such as A2C; default: all.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Environment steps; default: the paper's.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="How many seeds: 0, 1, …")] = 1,
    recipe: Annotated[str, typer.Option(help="published: the paper's settings; tuned: ours.")] = "published",
    episodes: Annotated[int | None, typer.Option(min=1, help="Evaluation episodes that count successes.")] = None,
    out: Annotated[Path, typer.Option(help="Results, one file a row; a row that is done is not run again.")] = Path(
        "runs/paper"
    ),
) -> None:
    """Repeat the CiRL paper's training runs and show their figures beside the published ones."""
    from cirl_marl.paper.plan import planned
    from cirl_marl.paper.results import Results
    from cirl_marl.paper.session import run_session

    rows = planned(environment, algorithm, steps=steps, seeds=seeds, recipe=recipe)
    try:
        run_session(rows, Results(out), console, success_episodes=episodes)
    except KeyboardInterrupt:
        message = f"\nstopped; finished rows are kept in {out}. The same command goes on."
        console.print(message, soft_wrap=True, highlight=False)
        raise typer.Exit(130) from None


def _only_resume(context: typer.Context) -> None:
    """Refuse options beside --resume: a resumed run keeps its own."""
    given = [
        f"--{name}"
        for name in context.params
        if name not in ("resume", "network", "episodes")
        and getattr(context.get_parameter_source(name), "name", "DEFAULT") != "DEFAULT"
    ]
    if given:
        raise CirlError(f"--resume goes on with the run as it was configured; leave out {', '.join(given)}")


def _evaluate_and_draw(directory: Path, episodes: int, seed: int) -> None:
    from cirl_marl.learners.run import RunDirectory
    from cirl_marl.report.run import draw_run, evaluate_run
    from cirl_marl.report.tables import evaluation_table

    run = RunDirectory(directory)
    with _bar("evaluating", 3 * run.make_env(1).network.episode.horizon) as progress:
        figures, rollouts, env = evaluate_run(
            run, episodes=episodes, seed=seed, progress=lambda _, steps: progress(None)
        )
    console.print(evaluation_table(figures))
    for path in draw_run(run, rollouts, env):
        console.print(f"picture: {path}", soft_wrap=True)
    console.print(
        f"run: {directory}  (figures in evaluation.json; more with: cirl evaluate {directory})", soft_wrap=True
    )


def _controller(control: str, settings: list[str]) -> Controller:
    if control not in CONTROLS:
        raise CirlError(f"--control: {unknown('control', control, CONTROLS)}")
    if settings and control not in ("constant", "scripted"):
        raise CirlError(f"--set goes with --control constant or scripted, not with {control}")
    actions = {}
    for setting in settings:
        agent, _, value = setting.partition("=")
        try:
            actions[agent] = float(value)
        except ValueError:
            raise CirlError(f"--set {setting}: needs AGENT=VALUE with a number in [-1, 1]") from None
    if control in ("random", "lqr"):
        return Random() if control == "random" else LQR()
    return Scripted(actions) if control == "scripted" else Constant(actions)


def _write_csv(path: Path, env: VectorEnv, time: np.ndarray, run: Rollout) -> None:
    from cirl_marl.learners.run import write_atomically

    network, physics = env.network, env.dynamics.inner
    header = [f"time ({network.time_unit})", f"circularity ({network.mass_unit})", "service level"]
    header += [f"stock of {node.id} ({network.mass_unit})" for node in network.nodes]
    header += [f"flow of {arc.id} ({network.mass_unit}/{network.time_unit})" for arc in network.arcs]
    header += [f"mass on {line.id} ({network.mass_unit})" for line in env.dynamics.batches.lines]
    header += [physics.names[row] for row in physics.visible]

    def write(target: Path) -> None:
        with target.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            columns = (time, run.circularity[0], run.service[0], *run.stock.T, *run.flow.T, *run.load.T, *run.inner.T)
            writer.writerows(zip(*(column.tolist() for column in columns), strict=True))

    write_atomically(path, write)


@contextmanager
def _bar(what: str, total: int) -> Iterator[Any]:
    """Progress bar; the yielded function takes the steps done so far, or None for one more."""
    with Progress(
        TextColumn(what), BarColumn(), TaskProgressColumn(), TimeRemainingColumn(), console=console, transient=True
    ) as progress:
        task = progress.add_task(what, total=total)

        def update(done: int | None) -> None:
            if done is None:
                progress.advance(task)
            else:
                progress.update(task, completed=done)

        yield update


@contextmanager
def _training_bar() -> Iterator[Any]:
    """Live line of a training: joint steps/s, λ̄ and service level of the last episode; plain lines if no terminal."""
    columns = (
        TextColumn("training"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[speed]:,.0f} joint steps/s"),
        TextColumn("λ̄ {task.fields[circularity]}"),
        TextColumn("service {task.fields[service]}"),
        TimeRemainingColumn(),
    )
    live = console.is_terminal
    with Progress(*columns, console=console, disable=not live) as progress:
        task = progress.add_task("training", total=None, speed=0.0, circularity="…", service="…")
        shown = clock.perf_counter()
        state: Any = None

        def update(now: Any) -> None:
            nonlocal shown, state
            state = now
            if now.episode:
                circularity, service = f"{now.circularity:.4g}", f"{now.service_level:.3f}"
                progress.update(task, circularity=circularity, service=service)
            if clock.perf_counter() - shown > (0.2 if live else 10.0):
                shown = clock.perf_counter()
                progress.update(task, completed=now.env_steps, total=now.total, speed=_speed(now))
                if not live:
                    _say(now)

        yield update
        if state is not None:
            progress.update(task, completed=state.total, total=state.total, speed=_speed(state))
            if not live:
                _say(state)


def _speed(state: Any) -> float:
    return float(state.env_steps / max(state.seconds, 1e-9))


def _say(state: Any) -> None:
    console.print(
        f"{min(state.env_steps, state.total):,}/{state.total:,} steps, {_speed(state):,.0f} joint steps/s, "
        f"λ {state.circularity:.4g}, service {state.service_level:.3f}"
    )


def _plain(error: BaseException) -> str:
    """Keep rich from reading brackets in a message as markup."""
    return str(error).replace("[", r"\[")


if __name__ == "__main__":
    main()
