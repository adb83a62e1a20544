"""``cirl compare | pareto | levers``: policies, controllers and levers against each other and the best possible."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from cirl_marl.cli import common
from cirl_marl.errors import CirlError
from cirl_marl.jobs import PLACES


@common.app.command(rich_help_panel=common.COMPARISONS)
def compare(
    runs: Annotated[
        list[Path] | None, typer.Argument(metavar="RUN...", help="Training runs of one environment; may be left out.")
    ] = None,
    controllers: Annotated[
        str, typer.Option(help=f"Comma-separated, of {common.CONTROLLERS}; neutral is always there.")
    ] = "neutral,random",
    network: Annotated[
        str | None,
        typer.Option(help="Catalogue name, FILE.toml or FILE.toml:REGION; default: the network of the runs."),
    ] = None,
    scenario: common.Scenario = None,
    episodes: Annotated[
        int | None, typer.Option(min=2, help="Fresh episodes; default: 16, or of a disturbed network 256 to 1024.")
    ] = None,
    seed: common.Seed = 0,
    min_service: common.MinService = None,
    at_most: common.AtMost = None,
    uncertain: common.Uncertain = None,
    tune: Annotated[
        int | None,
        typer.Option(help="Draws on which margins are set to deliver --min-service and keep --at-most on average."),
    ] = None,
    futures: Annotated[int | None, typer.Option(min=1, help="Futures that scenario_mpc plans for; default: 4.")] = None,
    bounds: Annotated[bool, typer.Option(help="Whether each episode is held against the best possible.")] = True,
    bound_draws: Annotated[
        int | None, typer.Option(help="Draws of the bound for who does not foresee, which are then the episodes.")
    ] = None,
    on: Annotated[str, typer.Option(help="Where draws of the bound are proved: here, local or ray.")] = "here",
    workers: Annotated[int | None, typer.Option(min=1, help="At a time; default: all that can be.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for episodes.csv, summary.csv, summary.json and comparison.png.")
    ] = None,
    html: common.Html = None,
) -> None:
    """Compare trained runs and controllers on the same fresh episodes, and with the best possible.

    Runs of one recipe with different seeds share a row: the interquartile mean over seeds with its bootstrap interval.
    The gap is to an upper bound, which no episode from the same start that serves at least as well exceeds.
    mpc and optimum solve linear programs for every episode: minutes for each on the larger networks.
    Where nothing bounds a network, optimum is the best plan that a search by simulation finds, without certificate.
    Nobody sees what is to come: mpc plans for what is expected from the present on, scenario_mpc for drawn futures,
    price_policy one interval ahead by the prices of --bound-draws; best_constant and best_schedule do not look at all.
    """
    from cirl_marl.definitions.catalogue import load_network
    from cirl_marl.evaluation import compare as compared
    from cirl_marl.evaluation.calibration import check_tuning
    from cirl_marl.evaluation.contenders import contenders
    from cirl_marl.learners.run_directory import RunDirectory
    from cirl_marl.optimum import Sampling, bound
    from cirl_marl.report.tradeoffs import comparison_notes, comparison_table, worst_table, write_comparison

    names = common.comma_separated(controllers)
    if tune is not None:
        check_tuning(tune, min_service)
    folder, page = None if out is None else common.folder_for(out, "--out"), common.page_for(html)
    options: dict[str, Any] = {"seed": seed, "min_service": min_service, "uncertain": uncertain}
    options["at_most"] = budgets = common.budgets(at_most)
    options |= {"tune": tune, "futures": futures, "bounds": bounds and bound_draws is None}
    bound_of_draws = None
    if bound_draws is None and (on, workers) != ("here", None):
        raise CirlError(f"--on {on}, --workers {workers}: only draws of --bound-draws are proved elsewhere")
    if bound_draws is None:
        options["episodes"] = _enough(16, network, scenario, runs or []) if episodes is None else episodes
    elif network is None:
        raise CirlError(f"--bound-draws {bound_draws} goes with --network")
    elif episodes is not None:
        raise CirlError(f"--bound-draws {bound_draws} is the number of episodes: leave out --episodes {episodes}")
    else:
        definition = load_network(network, scenario=scenario)
        # what cannot be compared is refused before the bound is computed, on which price_policy waits
        directories, free_names = [RunDirectory(run) for run in runs or ()], [n for n in names if n != "price_policy"]
        contenders(directories, free_names, definition, min_service, uncertain, futures=futures, at_most=budgets)
        sampling = Sampling(draws=bound_draws, seed=seed, numbers=bool(uncertain), on=on, workers=workers)
        bound_options: dict[str, Any] = {"min_service": min_service, "at_most": budgets, "uncertain": sampling}
        with common.shares() as progress:
            bound_of_draws = bound(definition, degree=1, progress=partial(progress, "bound"), **bound_options)
    with common.shares() as progress:
        place: dict[str, Any] = {"network": network, "scenario": scenario, "progress": progress}
        comparison = compared(runs or [], names, uncertain_bound=bound_of_draws, **place, **options)
    common.console.print(comparison_table(comparison))
    if comparison.network.disturbed:
        common.console.print(worst_table(comparison))
    for note in comparison_notes(comparison):
        common.say(note)
    options |= {"controllers": names, "bound_draws": bound_draws}
    files = [] if folder is None else write_comparison(comparison, folder, **options)
    for path in [*files, *common.browser_report(page, comparison)]:
        common.say(f"wrote {path}")


def _enough(certain: int, network: str | None, scenario: str | None, runs: Sequence[Path]) -> int | None:
    """Return the default number of episodes of a network, or else of that of the first run; None if it is disturbed."""
    from cirl_marl.definitions.catalogue import load_network
    from cirl_marl.learners.run_directory import RunDirectory

    if network is None and (scenario is not None or not runs):
        return certain  # nothing can be compared, which is told elsewhere
    definition = RunDirectory(runs[0]).network() if network is None else load_network(network, scenario=scenario)
    return None if definition.disturbed else certain


@common.app.command(rich_help_panel=common.COMPARISONS)
def pareto(
    network: common.NetworkName,
    recipe: Annotated[
        str | None, typer.Option(help="Learner recipe to train with several weights; default: bound and plans only.")
    ] = None,
    points: Annotated[
        int | None,
        typer.Option(min=2, help="Service levels of the bound, and weights of the learners, or demands on each aim."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Training seeds of each weight: 0, 1, …")] = 1,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Environment steps of each training; default: the recipe's.")
    ] = None,
    episodes: common.EpisodeCount = 16,
    scenario: common.Scenario = None,
    on: Annotated[str, typer.Option(help=f"Where learners are trained: {', '.join(PLACES)}.")] = "here",
    workers: Annotated[int | None, typer.Option(min=1, help="Trainings at a time; default: all that can be.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of pareto.csv, .json, .png and the runs; default: runs/pareto-NETWORK[_SCENARIO]."),
    ] = None,
    between: Annotated[
        str | None,
        typer.Option(help="AIM,AIM[,AIM]: two or three accounts or services; the first may be circularity."),
    ] = None,
    min_service: common.MinService = None,
    html: common.Html = None,
) -> None:
    """Draw service against circularity: what is possible, what plans achieve, what learners reach.

    The bound is swept over the service demanded, the learners over the weight of circularity in their reward, 0 to 1.
    Finished trainings are kept: the same command goes on where it was stopped.

    With --between two or three aims are held against each other, such as cost against emissions, or circularity against
    emissions and a service; --min-service is demanded of services that are no aim.
    """
    from cirl_marl.definitions.catalogue import load_network
    from cirl_marl.evaluation.pareto import pareto_front as swept
    from cirl_marl.report.tradeoffs import write_front

    page = common.page_for(html)
    stem = common.stem(load_network(network, scenario=scenario))
    folder = common.folder_for(out or Path("runs") / f"pareto-{stem}", "--out")
    if between is not None:
        if recipe is not None or html is not None:
            raise CirlError("--between goes without --recipe and --html")
        _between(network, scenario, between, min_service, points, folder)
        return
    if min_service is not None:
        raise CirlError("--min-service goes with --between; without it service is one of the aims")
    options: dict[str, Any] = {"points": points or 5, "seeds": seeds, "steps": steps, "episodes": episodes}
    with common.stoppable(f"finished trainings are kept in {folder}"), common.shares() as progress:
        place: dict[str, Any] = {"directory": folder, "on": on, "workers": workers}
        front = swept(network, recipe, scenario=scenario, progress=progress, **place, **options)
    for kind in ("bound", "plan", "trained", "neutral"):
        for point in front.of(kind):
            about = "" if point.weight is None else f"  (weight {point.weight:.3g}, seed {point.seed})"
            common.say(
                f"{kind:8} service {point.service:.4f}  λ̄ {point.circularity:.5g} {front.network.mass_unit}{about}"
            )
    if front.reason:
        common.say(f"no bound: {front.reason}")
    for path in [*write_front(front, folder, recipe=recipe, **options), *common.browser_report(page, front)]:
        common.say(f"wrote {path}")


def _between(
    network: str, scenario: str | None, axes: str, min_service: float | None, points: int | None, folder: Path
) -> None:
    """Hold an aim against demands on one or two others."""
    from cirl_marl.evaluation.account_front import account_front
    from cirl_marl.report.account_tables import front_table, write_account_front

    options: dict[str, Any] = {"scenario": scenario, "points": points, "min_service": min_service}
    with common.shares() as progress:
        front = account_front(network, common.comma_separated(axes), progress=progress, **options)
    common.console.print(front_table(front))
    proved, achieved = front.volumes
    if proved > 0:
        common.say(f"plans dominate {achieved / proved:.1%} of what the proved points do")
    for path in write_account_front(front, folder, between=axes, **options):
        common.say(f"wrote {path}")


@common.app.command(rich_help_panel=common.COMPARISONS)
def levers(
    network: common.NetworkName,
    group: Annotated[
        list[str] | None, typer.Option(help="Agents that are one lever: NAME=AGENT,AGENT,…; may be repeated.")
    ] = None,
    scenario: common.Scenario = None,
    min_service: Annotated[
        float | None,
        typer.Option(min=0.0, max=1.0, help="Mean level of each service; default: what there is as usual."),
    ] = None,
    bounds: Annotated[
        bool | None,
        typer.Option(help="Whether the bound of each row is solved; default: unless the network is large."),
    ] = None,
    most: Annotated[
        int, typer.Option(min=2, help="Most rows; levers that would come later are one lever in the last of them.")
    ] = 24,
    out: Annotated[
        Path | None, typer.Option(help="Folder of levers.csv, .json, .png; default: runs/levers-NETWORK[_SCENARIO].")
    ] = None,
) -> None:
    """Tell what each lever brings: alone, added to those above it, and what is lost without it.

    A lever is an agent; in copies, such as steel_world, the same agent of all regions. All is at the same service.
    """
    from cirl_marl.definitions.catalogue import load_network
    from cirl_marl.evaluation.levers import levers as levers_of
    from cirl_marl.report.lever_chart import levers_table, write_levers

    groups = common.values_by_name(group, "--group", "a name and agents, as in scrap=old_scrap,new_scrap", _members)
    variant = load_network(network, scenario=scenario)
    folder = common.folder_for(out or Path("runs") / f"levers-{common.stem(variant)}", "--out")
    options: dict[str, Any] = {"groups": groups, "min_service": min_service, "bounds": bounds, "most": most}
    with common.shares() as progress:
        result = levers_of(variant, progress=progress, **options)
    common.console.print(levers_table(result))
    for path in write_levers(result, folder, **options):
        common.say(f"wrote {path}")


def _members(text: str) -> list[str]:
    if not (members := common.comma_separated(text)):
        raise ValueError("a lever needs agents")
    return members
