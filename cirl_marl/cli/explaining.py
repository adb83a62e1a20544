"""``cirl explain | infer``: reasons for what is best and for what agents do, and the aims behind plans."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from cirl_marl.cli import common
from cirl_marl.cli.common import COMPARISONS, EpisodeCount, NetworkName, Scenario, Seed, app, console, say, shares


@app.command(rich_help_panel=COMPARISONS)
def explain(
    source: Annotated[
        str, typer.Argument(metavar="RUN | NETWORK", help="Training run; or a network, of which there are prices.")
    ],
    parts: Annotated[
        str | None,
        typer.Option(help="Comma-separated, of prices, inputs, rules; default: all, of a network the prices."),
    ] = None,
    min_service: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1.0,
            help="Mean level of each service behind the prices; default: what the policies deliver, or 99 % of the "
            "highest.",
        ),
    ] = None,
    episodes: EpisodeCount = 16,
    seed: Seed = 0,
    top: Annotated[int, typer.Option(min=1, help="Inputs of an agent that are held together.")] = 3,
    leaves: Annotated[int, typer.Option(min=2, help="Most leaves of a rule.")] = 4,
    scenario: Scenario = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to write; default: RUN/reasons or reasons_NETWORK[_SCENARIO].")
    ] = None,
) -> None:
    """Say why: what more of a stock, of demand or of room is worth, what agents look at, and rules that act like them.

    Prices are read off the certificate of the bound, of a disturbed network also by the state of each
    disturbance. Inputs are integrated gradients of each agent's action; the
    most important ones are held at their means, to see what becomes of λ̄. Rules are small decision trees, judged by
    what they lose in the policy's place. Inputs and rules need the extra explain. `cirl report RUN --html` shows what
    is found.
    """
    from cirl_marl.definitions.catalogue import load_network
    from cirl_marl.reasons.explanation import explain as explained
    from cirl_marl.report.explanations import FOLDER, inputs_table, prices_table, write_reasons

    is_run = (Path(source) / "config.json").is_file()
    if out is None:
        stem = "" if is_run else common.stem(load_network(source, scenario=scenario))
        out = Path(source) / FOLDER if is_run else Path(f"reasons_{stem}")
    folder = common.folder_for(out, "--out")
    options: dict[str, Any] = {"min_service": min_service, "episodes": episodes, "seed": seed, "top": top}
    chosen = None if parts is None else common.comma_separated(parts)
    with shares() as progress:
        explanation_ = explained(source, parts=chosen, scenario=scenario, leaves=leaves, progress=progress, **options)
    from cirl_marl.reasons.sentences import paragraphs

    if explanation_.prices is not None:
        console.print(prices_table(explanation_.prices))
    if explanation_.inputs:
        console.print(inputs_table(explanation_))
    for heading, texts in paragraphs(explanation_):
        say(f"\n{heading}")
        for sentence in texts:
            say(f"  {sentence}")
    for path in write_reasons(explanation_, folder, parts=parts, leaves=leaves, **options):
        say(f"wrote {path}")


@app.command(rich_help_panel=COMPARISONS)
def infer(
    network: NetworkName,
    plans: Annotated[
        list[str],
        typer.Argument(metavar="PLAN...", help="CSV files of cirl plan or simulate, or training runs; one or several."),
    ],
    terms: Annotated[
        str | None, typer.Option(help="Comma-separated, of circularity, services, set-points; default: all.")
    ] = None,
    within: Annotated[
        float,
        typer.Option(
            min=0.0, max=0.99, help="How far from the best plans may be, as share of what there is to be had."
        ),
    ] = 0.01,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes that are taken of a run.")] = 4,
    seed: Annotated[
        int | None, typer.Option(min=0, help="With which cirl plan started; of a run, of its episodes.")
    ] = None,
    seconds: Annotated[
        float, typer.Option(min=0.0, help="Processor time for programs; one under way is finished first.")
    ] = 60.0,
    scenario: Scenario = None,
    out: Annotated[Path | None, typer.Option(help="CSV file to write.")] = None,
) -> None:
    """Find what plans aim at: the weights of circularity, services and set-points under which they are best.

    Inverse linear programming with the rows of the bound: the weights that fit form a cone, which several plans narrow.
    Weights are shares of all, each term measured by how much of it there is to be had.
    """
    from cirl_marl.reasons.inverse import infer as inferred
    from cirl_marl.reasons.objective_terms import KINDS
    from cirl_marl.report.objective_weights import weights_sentences, weights_table, write_weights

    if out is not None:
        common.file_for(out, "--out", ".csv")
    kinds = KINDS if terms is None else common.comma_separated(terms)
    options: dict[str, Any] = {"scenario": scenario, "seed": seed, "episodes": episodes, "seconds": seconds}
    with common.bar("weighing") as progress:
        weights = inferred(network, plans, kinds=kinds, within=within, progress=progress, **options)
    console.print(weights_table(weights))
    for sentence in weights_sentences(weights):
        say(sentence)
    if out is not None:
        say(f"wrote {write_weights(weights, out)}")
