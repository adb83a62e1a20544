"""``cirl simulate | plan``: what a controller or policy does in one episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cirl_marl.cli import common
from cirl_marl.errors import CirlError

if TYPE_CHECKING:
    from cirl_marl.evaluation.simulations import Simulation


@common.app.command(rich_help_panel=common.EPISODES)
def simulate(
    network: common.NetworkName,
    control: Annotated[
        list[str] | None,
        typer.Option(help=f"Who acts: {common.CONTROLLERS}; repeat it to compare several; default: neutral."),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="AGENT=VALUE in [-1, 1], held constant under --control constant or scripted; repeatable."
        ),
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Control intervals; default: the horizon.")] = None,
    seed: common.EpisodeSeed = None,
    scenario: Annotated[
        list[str] | None,
        typer.Option(help="Scenario of the definition; repeat it to compare several; default: the physical one."),
    ] = None,
    samples: Annotated[
        int | None, typer.Option(min=2, help="Draws of what is uncertain or disturbed, for bands and what causes them.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Directory of CSV and picture; default: here.")] = None,
    iamc: Annotated[
        Path | None, typer.Option(help="CSV file of years in the IAMC format, for pyam, to write as well.")
    ] = None,
    package: Annotated[
        Path | None, typer.Option(help="Folder to write as well: network and episode as a Frictionless data package.")
    ] = None,
    html: common.Html = None,
) -> None:
    """Simulate a network under a controller without learning; write a CSV and a picture.

    Flows, and λ beside them in the picture, are means over each interval; the CSV has λ at its end as well.

    Several scenarios or controllers, or every pair of both, start from the same seed and are compared.
    There is a CSV of each, one picture of all, and a table of the differences to the first.

    With --samples uncertain numbers and disturbances are drawn so many times: bands in a CSV and a picture.
    From 70 samples on a table says which number causes most of the spread.
    """
    controls, page = control or ["neutral"], common.page_for(html)
    if samples is not None:
        if iamc is not None or package is not None:
            raise CirlError("--iamc and --package go without --samples")
        _sample(network, scenario or [None], controls, steps, 0 if seed is None else seed, samples, out, page)
        return
    from cirl_marl.definitions.catalogue import load_network
    from cirl_marl.evaluation.simulations import simulate_alternatives

    if package is not None and (len(controls) > 1 or len(scenario or ()) > 1):
        raise CirlError("--package holds one episode: give one scenario and one control")
    if package is not None and common.folder_for(package, "--package").exists():
        raise CirlError(f"--package {package}: exists; a data package is a folder of its own, so give another name")
    constants, folder = _constants(controls, set_ or []), common.folder_for(out or Path(), "--out")
    definition = load_network(network)
    scenarios: Sequence[str | None] = scenario or [None]
    if iamc is not None:
        from cirl_marl.report.iamc import iamc_years, write_iamc

        if common.file_for(iamc, "--iamc", ".csv").absolute() == folder.absolute():
            raise CirlError(f"--iamc {iamc}: is the folder of --out; give another name")
        changes = {} if steps is None else {"episode": {"horizon": steps}}
        variants = [definition.scenario(name).with_options(**changes) for name in scenarios]
        iamc_years([(variant, name) for variant in variants for name in controls])
    options: dict[str, Any] = {"controls": controls, "constants": constants, "steps": steps, "seed": seed}
    with common.bar("simulating") as progress:
        simulations = simulate_alternatives(definition, scenarios=scenarios, **options, progress=progress)
    files = {common.stem(simulation.network, simulation.control): simulation for simulation in simulations}
    if len(simulations) == 1:
        _write_one(folder, files)
    else:
        _write_several(folder, files)
    paths = common.browser_report(page, simulations)
    if iamc is not None:
        paths = [*paths, write_iamc(iamc, simulations)]
    if package is not None:
        from cirl_marl.report.data_package import write_package

        paths = [*paths, write_package(package, simulations[0])]
    for path in paths:
        common.say(f"wrote {path}")


def _sample(
    name: str,
    scenarios: Sequence[str | None],
    controls: Sequence[str],
    steps: int | None,
    seed: int,
    samples: int,
    out: Path | None,
    page: Path | None,
) -> None:
    """Simulate draws of uncertain numbers and disturbances, and write and say what came of them."""
    import numpy as np

    from cirl_marl.definitions.catalogue import load_network
    from cirl_marl.definitions.reader import DEFAULT
    from cirl_marl.evaluation.sampling import FEWEST, rbd_fast, sample_episodes, sensitivities
    from cirl_marl.report.samples import sensitivity_table, write_samples

    if len(scenarios) > 1 or len(controls) > 1:
        raise CirlError("--samples goes with one scenario and one control; compare their files")
    folder, network = common.folder_for(out or Path(), "--out"), load_network(name, scenario=scenarios[0])
    if steps is not None:
        network = network.with_options(episode={"horizon": steps})
    if samples >= FEWEST and network.uncertain:
        rbd_fast()  # or an error, before anything is simulated
    with common.bar("sampling") as progress:
        episodes = sample_episodes(network, samples=samples, control=controls[0], seed=seed, progress=progress)
    causes = sensitivities(episodes) if samples >= FEWEST else []
    scenario = "" if network.scenario_name == DEFAULT else f", scenario {network.scenario_name}"
    title = f"{network.title or network.name}{scenario}, {controls[0]} control, {samples} samples"
    paths = write_samples(folder, common.stem(network, controls[0]), episodes, causes, title=title)
    # a few bad samples draw the mean out of the interval, so that the median stands beside it
    for name, unit_of_figure, values in episodes.figures():
        unit, form = ("", ".4f") if unit_of_figure == "1" else (f" {unit_of_figure}", ".5g")
        low, median, high = np.quantile(values, (0.025, 0.5, 0.975)).tolist()
        spread = f"median {median:{form}}{unit}, 95 % of samples in [{low:{form}}, {high:{form}}]"
        common.say(f"{name}: {spread}; mean {values.mean():{form}}{unit}")
    if causes:
        common.console.print(sensitivity_table(episodes, causes))
    elif network.uncertain:
        common.say(f"which number causes the spread is told from {FEWEST} samples on")
    if page is not None:
        from cirl_marl.report.page_html import write_page
        from cirl_marl.report.report_page import page_of_samples

        paths.append(write_page(page, page_of_samples(episodes, controls[0])))
    common.say(f"wrote {', '.join(map(str, paths))}")


def _write_one(folder: Path, files: Mapping[str, Simulation]) -> None:
    from cirl_marl.report.trajectory import write_trajectory

    ((name, only),) = files.items()
    title = f"{only.network.title or only.network.name}, {only.control} control"
    paths = write_trajectory(folder, name, only, title)
    _say_lines(str(only))
    common.say(f"wrote {', '.join(map(str, paths))}")


def _write_several(folder: Path, files: Mapping[str, Simulation]) -> None:
    """Write and say what became of alternatives, and what differs between them."""
    from cirl_marl.evaluation.compared_quantities import rank_quantities
    from cirl_marl.report.differences import ROWS, differences_table, write_alternatives

    simulations = list(files.values())
    network, quantities = simulations[0].network, rank_quantities(simulations)
    controls = list(dict.fromkeys(simulation.control for simulation in simulations))
    title = f"{network.name}, {controls[0]} control" if len(controls) == 1 else network.name
    paths = write_alternatives(folder, f"{network.name}_differences", files, quantities, title=title)
    for simulation in simulations:
        _say_lines(str(simulation), f"{simulation.name}: ")
    if unequal := [simulation for simulation in quantities if simulation.rank > 0]:
        common.console.print(differences_table(simulations, unequal))
    more = f", of which {ROWS} are shown" if len(unequal) > ROWS else ""
    common.say(f"{len(unequal)} of {len(quantities)} quantities differ{more}; all are in {paths[-2]}")
    for path in paths:
        common.say(f"wrote {path}")


@common.app.command(rich_help_panel=common.EPISODES)
def plan(
    source: Annotated[
        str, typer.Argument(metavar="RUN | NETWORK", help="Training run; or with --control a network, as elsewhere.")
    ],
    control: Annotated[
        str | None, typer.Option(help=f"Who acts in a network: {common.CONTROLLERS}; a run acts by its policies.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="CSV file to write; default: plan_NETWORK[_SCENARIO]_CONTROL or plan_RUN."),
    ] = None,
    scenario: common.Scenario = None,
    seed: common.EpisodeSeed = None,
    min_service: common.MinService = None,
    smooth: Annotated[
        bool | None,
        typer.Option(help="Of optimum's plans of equal worth the one with least change; default: unless it is large."),
    ] = None,
    gap: Annotated[
        float | None,
        typer.Option(help="Of optimum: prove and plan until it is at most this part of the bound, such as 0.01."),
    ] = None,
    aim: Annotated[
        list[str] | None,
        typer.Option(
            help="Of mpc and optimum: circularity, or the account to keep low beside --min-service; or NAME=WEIGHT of "
            "several (repeatable)."
        ),
    ] = None,
    at_most: common.AtMost = None,
    html: common.Html = None,
) -> None:
    """Write what a policy or controller does in one episode, beside business as usual, and what that saves.

    The CSV has a row for each control interval: when it begins and ends (if the network has a start on the calendar
    with the year or date on which it begins), the value of every control (a flow ordered, a share, a factor on a
    lifetime or on what a valve lets through, or an input of a model) with its unit, flows, circularity, service level
    and stocks. The workbook beside it (.xlsx) has the decisions in words, with stocks and flows, as planned and as
    usual; the picture (.png) the levers that differ most.
    """
    from cirl_marl.evaluation import plans
    from cirl_marl.report.decisions import NO_WORKBOOK, decisions_table, savings_table, write_decisions

    if out is not None:
        common.file_for(out, "--out", ".csv", beside=(".xlsx", ".png"))
    page = common.page_for(html)
    options: dict[str, Any] = {"scenario": scenario, "min_service": min_service, "seed": seed, "smooth": smooth}
    options |= {"gap": gap, "aim": _aim(aim), "at_most": common.budgets(at_most)}
    with common.bar("planning") as progress:
        schedule = plans.plan(source, control, **options, progress=progress)
    network = schedule.network
    stem_of_file = Path(source).resolve().name if control is None else common.stem(network, control)
    path = Path(f"plan_{stem_of_file}.csv") if out is None else out
    path.parent.mkdir(parents=True, exist_ok=True)
    schedule.write(path)
    beside = write_decisions(path, schedule, title=f"{network.title or network.name}: {control or 'what was learnt'}")
    if path.with_suffix(".xlsx") not in beside:
        common.say(NO_WORKBOOK)
    beside += common.browser_report(page, schedule)
    common.console.print(decisions_table(schedule))
    common.console.print(savings_table(schedule))
    _say_lines(str(schedule))
    common.say(f"wrote {', '.join(map(str, (path, *beside)))}")


def _aim(entries: list[str] | None) -> str | dict[str, float]:
    if entries and len(entries) == 1 and "=" not in entries[0]:
        return entries[0]
    form = "a single NAME, or NAME=WEIGHT with a number"
    return common.values_by_name(entries, "--aim", form, float) or "circularity"


def _say_lines(text: str, prefix: str = "") -> None:
    for line in text.splitlines():
        common.say(prefix + line)


def _constants(controls: Sequence[str], settings: list[str]) -> dict[str, float]:
    from cirl_marl.optimum.registry import SETTABLE

    if settings and not set(controls) & set(SETTABLE):
        raise CirlError(f"--set goes with --control constant or scripted, not with {', '.join(controls)}")
    return common.values_by_name(settings, "--set", "AGENT=VALUE with a number in [-1, 1]", float)
