"""``cirl train | evaluate | report | paper``: learning and what came of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cirl_marl.cli import common
from cirl_marl.errors import CirlError
from cirl_marl.jobs import PLACES, JobStatus, run_jobs

EVALUATION_SHARE = 0.6
"""Share of the evaluation in the work on a page; the rest is to plan."""

if TYPE_CHECKING:
    from rich.table import Table

    from cirl_marl.evaluation.assessment import Evaluation
    from cirl_marl.paper.results import PaperRow, Results


@common.app.command(rich_help_panel=common.LEARNERS)
def train(
    context: typer.Context,
    network: Annotated[
        str | None, typer.Argument(metavar="NETWORK", help="Catalogue name, FILE.toml or FILE.toml:REGION.")
    ] = None,
    recipe: Annotated[
        str | None,
        typer.Option(
            help="Who learns how: catalogue name or .toml file; default: exact_gradients, or independent_ars where the "
            "network has no derivatives."
        ),
    ] = None,
    agents: Annotated[
        str | None, typer.Option(help="Who acts and learns, comma-separated ids; default: the network's choice.")
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Environment steps, summed over the copies.")] = None,
    envs: Annotated[int | None, typer.Option(min=1, help="Copies of the environment.")] = None,
    engine: Annotated[
        str | None,
        typer.Option(help="auto, lockstep, stacked (same learners as one) or gradients; default: the recipe's."),
    ] = None,
    min_service: Annotated[
        float | None,
        typer.Option(
            min=0, max=1, help="Level that each service must reach for a checkpoint to act; default: the recipe's."
        ),
    ] = None,
    device: Annotated[str, typer.Option(help="Where stacked learners compute: cpu, cuda, …")] = "cpu",
    seed: common.Seed = 0,
    seeds: Annotated[
        int, typer.Option(min=1, help="So many runs together, of this seed and the next ones, in OUT-seedN.")
    ] = 1,
    scenario: common.Scenario = None,
    reward: Annotated[str | None, typer.Option(help=f"{common.REWARDS}; default: the recipe's.")] = None,
    observe: Annotated[
        str | None, typer.Option(help=f"{common.OBSERVE}; default: the recipe's, else the definition's.")
    ] = None,
    countdown: Annotated[
        bool | None, typer.Option(help="Whether agents see how many intervals are left; default: as for observe.")
    ] = None,
    uncertain: common.Uncertain = None,
    out: Annotated[Path | None, typer.Option(help="Run directory; default: runs/NETWORK-RECIPE-seedN.")] = None,
    resume: Annotated[
        Path | None, typer.Option(metavar="RUN", help="Go on with an interrupted run; with --steps, to so many.")
    ] = None,
    checkpoint_every: common.CheckpointEvery = None,
    episodes: common.EpisodesOfRun = None,
) -> None:
    """Train one learner per compartment, all at once, then evaluate them and draw what changed.

    Ctrl-C, SIGTERM and SIGHUP save the run and end with code 130: it is interrupted, and --resume goes on with it.
    """
    from cirl_marl.definitions.catalogue import load_network
    from cirl_marl.learners import interface

    if network is None and resume is None:
        raise CirlError("train needs NETWORK, or --resume RUN")
    if network is not None and resume is not None:
        raise CirlError(f"--resume goes on with the network of its run; leave out {network}")
    if resume is not None:
        _only_resume(context)
    options: dict[str, Any] = {"steps": steps, "envs": envs, "scenario": scenario, "reward": reward, "engine": engine}
    options |= {"min_service": min_service, "uncertain": uncertain, "checkpoint_every": checkpoint_every}
    names = None if agents is None else common.comma_separated(agents)
    options |= {"observe": observe, "countdown": countdown, "agents": names, "device": device}
    all_seeds = range(seed, seed + seeds)
    if resume is None and recipe is None:
        recipe = interface.default_recipe(load_network(str(network), scenario=scenario))
    directories = [resume] if resume is not None else _directories(out, str(network), str(recipe), all_seeds)
    with common.training_bar() as report:
        options["report"] = report
        try:
            if resume is not None:
                resume_options: dict[str, Any] = {"device": device, "checkpoint_every": checkpoint_every}
                interface.resume(resume, steps=steps, report=report, **resume_options)
            elif seeds > 1:
                parent = str(directories[0]).removesuffix(f"-seed{seed}")
                interface.train_seeds(str(network), recipe, seeds=all_seeds, directory=parent, **options)
            else:
                interface.train(str(network), recipe, seed=seed, directory=directories[0], **options)
        except KeyboardInterrupt:
            for directory in directories:
                common.console.print(f"\nstopped; {what_is_kept(directory)}", soft_wrap=True, highlight=False)
            raise typer.Exit(130) from None
    for directory in directories:
        evaluate_and_draw(directory, episodes, 0)


def _directories(out: Path | None, network: str, recipe: str, seeds: Sequence[int]) -> list[Path]:
    from cirl_marl.definitions.catalogue import load_network

    parent = out or Path("runs") / f"{load_network(network).name}-{Path(recipe).stem}"
    return [out] if out is not None and len(seeds) == 1 else [Path(f"{parent}-seed{seed}") for seed in seeds]


@common.app.command(rich_help_panel=common.LEARNERS)
def evaluate(run: common.RunPath, episodes: common.EpisodesOfRun = None, seed: common.Seed = 0) -> None:
    """Compare the trained policies with neutral and random control on fresh seeds, and with the best possible.

    The gap is to an upper bound, which no episode from the same start that serves at least as well exceeds.
    """
    from cirl_marl.evaluation import assessment
    from cirl_marl.report.terminal import local_returns_table

    with common.shares() as progress:
        evaluation = assessment.evaluate(run, episodes=episodes, seed=seed, progress=progress)
    _keep_and_say(evaluation, local_returns_table(evaluation.figures))
    if "no_bound" in evaluation.figures:
        common.say(f"gap to bound: {evaluation.figures['no_bound']}")


@common.app.command(rich_help_panel=common.LEARNERS)
def export(
    run: common.RunPath,
    out: Annotated[Path, typer.Option(help="Folder for the files; those of the same names are replaced.")],
) -> None:
    """Write the trained policies as files that Stable-Baselines3 loads; this library itself never reads such files."""
    from cirl_marl.learners import interface

    for path in interface.export(run, out):
        common.say(f"{path}")


@common.app.command(rich_help_panel=common.LEARNERS)
def report(
    run: common.RunPath, episodes: common.EpisodesOfRun = None, seed: common.Seed = 0, html: common.Html = None
) -> None:
    """Evaluate a run and draw its pictures anew.

    With --html the policies stand beside business as usual and the plan of the bound: as long as ``cirl evaluate``.
    """
    evaluate_and_draw(run, episodes, seed, common.page_for(html))


@common.app.command(rich_help_panel=common.LEARNERS)
def paper(
    environment: Annotated[str | None, typer.Argument(metavar="ENV", help="Such as CopperNet; default: all.")] = None,
    algorithm: Annotated[str | None, typer.Argument(metavar="ALGORITHM", help="Such as A2C; default: all.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Environment steps; default: the paper's.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="How many seeds: 0, 1, …")] = 1,
    settings: Annotated[
        str, typer.Option("--recipe", help="published: the paper's settings; tuned: our recipes.")
    ] = "published",
    episodes: Annotated[
        int | None, typer.Option(min=1, help="Evaluation episodes; default: 100, where successes count the paper's.")
    ] = None,
    on: Annotated[str, typer.Option(help=f"Where rows are run: {', '.join(PLACES)}.")] = "here",
    workers: Annotated[int | None, typer.Option(min=1, help="Rows at a time; default: all that can be.")] = None,
    out: Annotated[Path, typer.Option(help="Results, one file a row; a row that is done is not run again.")] = Path(
        "runs/paper"
    ),
) -> None:
    """Repeat the CiRL paper's training runs, half a day in all, and show their figures beside the published ones."""
    from cirl_marl.paper.published import ENVIRONMENTS
    from cirl_marl.paper.results import Results
    from cirl_marl.paper.row_selection import overview, select_rows
    from cirl_marl.paper.rows import reason_to_repeat
    from cirl_marl.paper.table import environment_table, result_line
    from cirl_marl.paper.training import check_registered

    rows, results = select_rows(environment, algorithm, steps=steps, seeds=seeds, settings=settings), Results(out)
    environments = [ENVIRONMENTS[name] for name in dict.fromkeys(row.environment for row in rows)]
    for environment_data in environments:
        check_registered(environment_data)
    results.prepare()
    reasons = {row: reason_to_repeat(results.read(row), episodes) for row in rows if results.has(row)}
    rest = [row for row in rows if row not in reasons or reasons[row]]
    common.say(f"{overview(rows, rest)}; results in {results.path}")
    for row in rows:
        if reasons.get(row):
            common.say(f"{row}: once more, as {reasons[row]}")
        elif row in reasons:
            common.say(result_line(results.read(row)))
    with common.stoppable(f"finished rows are kept in {out}"):
        has_failures = _run_rows(rest, results, episodes, on, workers)
    results_on_disk, requests = results.read_all(), {_request(row) for row in rows}
    for environment_data in environments:
        fit = [result for result in results_on_disk if result.row in rows or _request(result.row) not in requests]
        common.console.print(environment_table(environment_data, fit))
    if has_failures:
        raise typer.Exit(1)


def _request(row: PaperRow) -> tuple[str, str, str]:
    return row.environment, row.algorithm, row.settings


def _run_rows(rows: Sequence[PaperRow], results: Results, episodes: int | None, on: str, workers: int | None) -> bool:
    """Train and evaluate rows of the paper's tables, keep the results, and return whether any has failed."""
    from cirl_marl.paper.rows import RowJob
    from cirl_marl.paper.table import result_line

    jobs = {row.stem: RowJob(row, results.path, episodes) for row in rows}
    names_shown: set[str] = set()
    with common.shares() as progress:

        def watch(statuses: Sequence[JobStatus]) -> None:
            for status in statuses:
                if status.state == "done" and status.name not in names_shown:
                    names_shown.add(status.name)
                    common.say(result_line(results.read(jobs[status.name].row)))
                elif status.state == "running":
                    place = f"{len(names_shown) + 1} of {len(rows)}"
                    progress(f"{place}: {jobs[status.name].row}: {status.figures.get('what', '')}", status.share)

        failures = run_jobs([*jobs.values()], results.path / "logs", on=on, workers=workers, watch=watch)
    for failure in failures:
        message = failure.error if isinstance(failure.error, CirlError) else failure.message
        common.say(f"{jobs[failure.name].row}: failed: {message}")
    return bool(failures)


def _only_resume(context: typer.Context) -> None:
    """Refuse options beside --resume: a resumed run keeps its own."""
    exceptions = ("resume", "network", "episodes", "steps", "device", "checkpoint_every")
    sources = {name: context.get_parameter_source(name) for name in context.params if name not in exceptions}
    if surplus := [f"--{name}" for name, source in sources.items() if getattr(source, "name", "DEFAULT") != "DEFAULT"]:
        raise CirlError(f"--resume goes on with the run as it was configured; leave out {', '.join(surplus)}")


def what_is_kept(directory: Path) -> str:
    """Say what a training that was stopped has left."""
    from cirl_marl.learners.run_directory import RunDirectory

    run = RunDirectory(directory)
    if not (directory / "status.json").is_file() or run.status["checkpoint"] is None:
        return "nothing was learnt yet that could be saved"
    status, go_on = run.status, f"Go on with: cirl train --resume {directory}"
    if status["state"] == "interrupted":
        return f"everything learnt is saved. {go_on}"
    return f"what was learnt in the first {status['joint_steps'] * run.config.envs:,} steps is saved. {go_on}"


def _keep_and_say(evaluation: Evaluation, *tables: Table) -> None:
    """Keep the figures in the run, if they can be, and say them, who acts, and under which control what fell short."""
    from cirl_marl.controllers.outcome import shortage_lines
    from cirl_marl.evaluation.assessment import acting_checkpoint
    from cirl_marl.report.terminal import evaluation_table
    from cirl_marl.report.tradeoffs import worst_table

    try:
        evaluation.write()
    except OSError as error:
        common.say(f"evaluation.json could not be written: {error}")
    common.console.print(evaluation_table(evaluation.figures))
    if evaluation.comparison.network.disturbed:
        common.console.print(worst_table(evaluation.comparison))
    for table in tables:
        common.console.print(table)
    common.say(acting_checkpoint(evaluation.run))
    for name, rollout in evaluation.rollouts.items():
        for line in shortage_lines(evaluation.env.network, rollout):
            common.say(f"{name}: {line}")


def evaluate_and_draw(directory: Path, episodes: int | None, seed: int, page: Path | None = None) -> None:
    """Evaluate a run, say what came of it and draw its pictures; with ``page`` also hold it against the best."""
    from cirl_marl.evaluation import assessment
    from cirl_marl.evaluation.comparison import part_of
    from cirl_marl.report.presentation import draw_run
    from cirl_marl.report.report_page import PLAN, page_of_evaluation

    share = 1.0 if page is None else EVALUATION_SHARE
    with common.shares() as progress:
        evaluation = assessment.evaluate(
            directory,
            episodes=episodes,
            seed=seed,
            bounds=page is not None,
            progress=lambda activity, part: progress(activity, share * part),
        )
        story = None if page is None else page_of_evaluation(evaluation, part_of(progress, PLAN, share, 1 - share))
    _keep_and_say(evaluation)
    for path in draw_run(evaluation):
        common.say(f"picture: {path}")
    if page is not None and story is not None:
        from cirl_marl.report.page_html import write_page

        common.say(f"wrote {write_page(page, story)}")
    run = evaluation.run
    if not run.metrics()["env_steps"]:
        minimum = run.config.envs * evaluation.env.network.episode.horizon
        common.say(f"no learning curves, as no episode ended: {run.config.envs} copies need {minimum:,} steps")
    common.say(f"run: {directory}  (figures in evaluation.json; gap to the bound and more: cirl evaluate {directory})")
