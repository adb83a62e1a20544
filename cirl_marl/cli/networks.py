"""``cirl networks | show | check``: what networks and recipes are, and what is wrong with them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cirl_marl.cli import common
from cirl_marl.errors import CirlError, unknown_name

if TYPE_CHECKING:
    from cirl_marl.learners.recipe import Recipe
    from cirl_marl.network import Network


@common.app.command("networks", rich_help_panel=common.NETWORKS)
def list_networks(
    every_region: Annotated[
        bool, typer.Option("--all", help="A row for each region of a definition that has regions.")
    ] = False,
) -> None:
    """List the networks and the learner recipes of the catalogue."""
    from cirl_marl.definitions.catalogue import definitions, recipes
    from cirl_marl.report.terminal import networks_table

    common.console.print(networks_table(definitions(), all_regions=every_region))
    common.console.print(f"recipes for --recipe: {', '.join(recipes())}")


@common.app.command(rich_help_panel=common.NETWORKS)
def new(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The definition to write, such as my.toml.")],
    material: Annotated[str, typer.Option(prompt="Which material", help="What flows.")],
    mass: Annotated[str, typer.Option(prompt="Unit of mass (such as t, kt, Mt)", help="Unit of mass.")],
    recycled_share: Annotated[
        float,
        typer.Option(
            "--recycled", prompt="Share of discards that is recycled today (0 to 1)", help="Share that is recycled."
        ),
    ],
    growth: Annotated[float, typer.Option(help="Growth of what is in use, percent a year.")] = 0.0,
    start: Annotated[int, typer.Option(help="First year.")] = 2025,
    years: Annotated[int, typer.Option(help="How many years the episode lasts.")] = 25,
    in_use: Annotated[float | None, typer.Option(help="Mass in use at the start.")] = None,
    lifetime: Annotated[float | None, typer.Option(help="Mean lifetime in years.")] = None,
    product: Annotated[
        list[str] | None,
        typer.Option(help="NAME=IN_USE,LIFETIME of a product with a demand of its own, in place of both; repeated."),
    ] = None,
) -> None:
    """Write a first network of your own: a material that is made, used for years, discarded, and recycled in part.

    What is not given is asked for. Every number stands in the file with its source, to be changed.
    """
    from cirl_marl.definitions.template import FirstCycle, write_first

    form = "a name and two numbers, as in cars=120,14"
    products = common.values_by_name(product, "--product", form, _mass_and_years)
    if products and (in_use, lifetime) != (None, None):
        raise CirlError("--product says how much is in use and how long; leave out --in-use and --lifetime")
    if not products:
        in_use = typer.prompt("How much of it is in use", type=float) if in_use is None else in_use
        lifetime = typer.prompt("How many years it stays in use", type=float) if lifetime is None else lifetime
    options: dict[str, Any] = {"growth": growth, "start": start, "years": years, "products": products}
    options |= {"in_use": 1.0 if in_use is None else in_use, "lifetime": 1.0 if lifetime is None else lifetime}
    write_first(FirstCycle(material=material, mass=mass, recycled=recycled_share, **options), file)
    common.say(f"wrote {file}; next: cirl plan {file} --control optimum --min-service 1, and cirl train {file}")


def _mass_and_years(text: str) -> tuple[float, float]:
    in_use, lifetime = map(float, text.split(","))
    return in_use, lifetime


@common.app.command(rich_help_panel=common.NETWORKS)
def show(
    network: common.NetworkName,
    scenario: common.Scenario = None,
    seed: common.EpisodeSeed = None,
    picture: Annotated[
        Path | None, typer.Option(help="Where to draw it; default: NETWORK[_SCENARIO].png here.")
    ] = None,
    unfold: Annotated[
        list[str] | None, typer.Option(help="A copy that is not shown as one box, such as japan in steel_world.")
    ] = None,
    substance: Annotated[
        str | None, typer.Option(help="Colour the picture by the content of a substance, such as copper.")
    ] = None,
) -> None:
    """Show the compartments, flows and circularity of a network at its start state, and draw it."""
    import numpy as np

    from cirl_marl.controllers.rollout import episode_start
    from cirl_marl.definitions.catalogue import load_network
    from cirl_marl.drawing.content_colours import SubstanceAmounts
    from cirl_marl.drawing.digraph import save_network
    from cirl_marl.drawing.folding import fold_copies
    from cirl_marl.environments.vector import MultiAgentVectorEnv
    from cirl_marl.network.series import Series, extremes, product
    from cirl_marl.report.terminal import arcs_table, disturbances_table, nodes_table

    definition = load_network(network, scenario=scenario)
    env = MultiAgentVectorEnv(definition, num_envs=1)
    names = [part.id for part in definition.substances]
    if substance is not None and substance not in names:
        raise CirlError(f"--substance: {unknown_name('substance', substance, names)}")
    start = episode_start(env, seed)
    start.reset(env)
    stock, flow = env.rows.stocks(env.physical.stock)[:, 0], env.physical.flow[:, 0]
    folded_view = fold_copies(definition, stock, flow, unfold or ())
    common.console.print(nodes_table(folded_view[0], folded_view[1]))
    common.console.print(arcs_table(folded_view[0], folded_view[2]))
    mass, rate = f" {definition.mass_unit}", f" {definition.mass_unit}/{definition.time_unit}"
    units = {"stock": mass, "outflow": rate, "flow": rate, "measure": ""}
    for service in definition.services:
        scale, unit = (100.0, " %") if service.substance else (1.0, units[service.quantity])
        ends = [f"at least {product(service.low, scale):g}{unit}"] if extremes(service.low)[1] > 0 else []
        ends += [] if np.isinf(extremes(service.high)[0]) else [f"at most {product(service.high, scale):g}{unit}"]
        variation = ", changing in time" if isinstance(service.low, Series) or isinstance(service.high, Series) else ""
        subject = f"{service.subject} of {' and '.join(service.providers)}"
        common.console.print(f"service '{service.id}': {subject} {' and '.join(ends)}{variation}")
    if definition.disturbed:
        common.console.print(disturbances_table(definition))
    circularity = float(definition.circularity(flow))
    common.console.print(f"λ of the start state: {circularity:.5g} {definition.mass_unit}")
    common.say(f"start: {start.description}")
    path = common.file_for(picture or Path(f"{common.stem(definition)}.png"), "--picture", ".png")
    colours = None
    if substance is not None:
        place = names.index(substance)
        stocks, flows = env.rows.substances(env.physical.stock), env.physical.substances
        parts = (table.reshape(len(names), -1)[place] for table in (stocks, flows))
        colours = SubstanceAmounts(substance.replace("_", " "), *parts)
    save_network(
        path,
        definition,
        stock,
        flow,
        title=definition.title,
        circularity=circularity,
        open_copies=unfold or (),
        substance=colours,
    )
    common.console.print(f"picture: {path}")


@common.app.command(rich_help_panel=common.NETWORKS)
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
    faulty, names = False, [name for argument in sources for name in _with_regions(argument)]
    with common.bar("checking") as progress:
        for i, source in enumerate(names):
            try:
                if _is_recipe(source):
                    _check_recipe(source, network)
                elif network is None:
                    _check_network(source, progress, i, len(names))
                else:
                    raise CirlError(f"check {source}: is no recipe; --network names the network that recipes must fit")
            except CirlError as error:
                faulty = True
                common.errors.print(common.plain(error), highlight=False, soft_wrap=True)
            progress((i + 1) / len(names))
    if faulty:
        raise typer.Exit(2)


def _with_regions(source: str) -> list[str]:
    """Return a file as it is, or once for each region that it has."""
    from cirl_marl.definitions.reader import read_toml

    try:
        regions = read_toml(Path(source)).get("regions") if source.endswith(".toml") else None
    except CirlError:  # a mistake of the file, which the check says
        return [source]
    return [f"{source}:{region}" for region in regions] if isinstance(regions, dict) and regions else [source]


def _is_recipe(source: str) -> bool:
    """Whether a file says how to learn, or a name is that of a recipe."""
    from cirl_marl.definitions.reader import read_toml

    if not source.endswith(".toml"):
        from cirl_marl.definitions.catalogue import recipes

        return source in recipes()
    return bool({"learner", "run", "match"} & set(read_toml(Path(source))))


def _check_recipe(source: str, network: str | None) -> None:
    from cirl_marl.definitions.catalogue import load_network
    from cirl_marl.learners.recipe import load_recipe

    recipe = load_recipe(source)
    idle = [] if network is None else _idle_matches(source, recipe, load_network(network))
    algorithms = ", ".join(dict.fromkeys(learner.algorithm for _, learner in recipe.learners()))
    fit = "" if network is None else f", in {network}"
    common.say(
        f"{source}: recipe of {algorithms}, {recipe.run.steps:,} steps in {recipe.run.envs} copies{fit}: no mistakes"
    )
    for match in idle:
        common.say(f"{source}: remark on {network}: nobody learns by {match}")


def _idle_matches(source: str, recipe: Recipe, network: Network) -> list[str]:
    """Prepare a training, as far as it goes without training, and return the matches by which nobody learns."""
    from cirl_marl.learners.interface import prepare

    try:
        learners = prepare(network, recipe).learners.values()
    except CirlError as error:
        raise CirlError(f"{source} in {network.name}: {error}") from error
    busy = {id(learner.spec) for learner in learners}
    return [match for match, learner in recipe.learners()[1:] if id(learner) not in busy]


def _check_network(source: str, progress: Callable[[float], None], place: int, count: int) -> None:
    from cirl_marl.controllers.lint import lint_warnings
    from cirl_marl.definitions.catalogue import definition, load_network
    from cirl_marl.environments.vector import MultiAgentVectorEnv

    network = load_network(source)
    assert network.source is not None
    definition(network.source).check(network.region)
    remarks: list[str] = []
    for i, variant in enumerate((network, *network.scenarios.values()), start=1):
        try:  # finds what only a network that is run says, as rates no solver can follow
            env = MultiAgentVectorEnv(variant, num_envs=1)
        except CirlError as error:
            raise CirlError(f"{source}, scenario '{variant.scenario_name}': {error}") from error
        remarks += (f"scenario '{variant.scenario_name}': {remark}" for remark in lint_warnings(variant, env))
        progress((place + i / (1 + len(network.scenarios))) / count)
    agents = f"{len(network.agents)} agent{'' if len(network.agents) == 1 else 's'}"
    common.say(
        f"{source}: {len(network.compartments)} compartments, {agents}, "
        f"scenarios {', '.join([network.scenario_name, *network.scenarios])}: no mistakes"
    )
    for remark in remarks:
        common.say(f"{source}: remark on {remark}")
