"""Writes the tables of ``docs/reference.md`` from the code: ``python -m docs.site.reference``, of ``make written``.

A network has a row with its title, a recipe its title, a command the first line of its help.
"""

from __future__ import annotations

import typer.main

from benchmarks.document import write_sections
from cirl_marl import cli, load_network, recipes
from cirl_marl.definitions.catalogue import families
from cirl_marl.definitions.ids import ids
from cirl_marl.environments.registration import PAPER_ENVIRONMENTS
from cirl_marl.learners.recipe import load_recipe
from docs.site.markdown import ROOT, table

DOCUMENT = ROOT / "docs" / "reference.md"


def reference_tables() -> dict[str, str]:
    """Return the tables by the names of their marks."""
    return {
        "networks": _networks(),
        "environments": _environments(),
        "recipes": table(("recipe", "what it is"), ((f"`{name}`", load_recipe(name).title) for name in recipes())),
        "commands": _commands(),
    }


def _networks() -> str:
    rows = []
    for names in families().values():
        network = load_network(names[0])
        size = f"{len(network.compartments)} ({len(network.nodes)} nodes, {len(network.arcs)} arcs)"
        services = [service.title or service.id.replace("_", " ") for service in network.services]
        served = ", ".join(services[:2]) + (f" and {len(services) - 2} more" if len(services) > 2 else "")
        name = f"`{names[0]}`" + (f" and {len(names) - 1} more" if len(names) > 1 else "")
        rows.append((name, network.title, size, len(network.agents), served))
    return table(("network", "what it is", "compartments", "agents", "services"), rows)


def _environments() -> str:
    rows = (
        (f"`{ids()[name]}`", f"`{agent}`", f"`{network}`", f"`{scenario}`")
        for name, (network, agent, scenario) in PAPER_ENVIRONMENTS.items()
    )
    return table(("Gymnasium id", "agent", "network", "scenario"), rows)


def _commands() -> str:
    commands = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]
    rows = (
        (f"`cirl {name}`", str(command.help).partition("\n\n")[0].replace("\n", " "))
        for name, command in commands.items()
    )
    return table(("command", "what it does"), rows)


if __name__ == "__main__":
    write_sections(DOCUMENT, reference_tables())
