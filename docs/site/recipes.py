"""A page for each learner recipe of the catalogue, made from its file."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from cirl_marl.definitions.catalogue import networks, recipe_path
from cirl_marl.learners.recipe import LearnerSettings, Recipe, load_recipe
from cirl_marl.paper.published import ENVIRONMENTS
from cirl_marl.paper.row_selection import tuned_recipe
from docs.site.markdown import GeneratedPage, table
from docs.site.networks import STUDY, check_study, interval


def recipe_page(name: str) -> GeneratedPage:
    """Return the page of a recipe.

    Raises:
        CirlError: if results that it shows are of another network than the catalogue's.
    """
    recipe = load_recipe(name)
    path = recipe_path(name)
    parts = [
        f"# {name}",
        f"{recipe.title}.",
        "How recipes are written, and what schemes, engines and prices are: [agents/README.md](../agents/README.md).",
        f"```\n{_command(recipe)}\n```",
        "## Who learns how",
        table(("for whom", "algorithm", "who learns", "policy", "counts beyond the time limit"), _learners(recipe)),
        "## Settings",
        "What the file says and what it leaves to the defaults. Parameters are those of the algorithm's class.",
        table(("what", "value"), _settings(recipe)),
        *_results(name),
        "## The file",
        f"```toml\n{path.read_text(encoding='utf-8').strip()}\n```",
    ]
    return GeneratedPage(f"recipes/{name}.md", name, "\n\n".join(parts) + "\n")


def _command(recipe: Recipe) -> str:
    """Return a command that learns by the recipe: in the paper's environment, or in the network that it is made for.

    That is the one that its name or its title names; else it is for any, and the benchmark stands for these.
    """
    tuned = {tuned_recipe(name): name for name in ENVIRONMENTS}
    if recipe.name in tuned:
        return f"cirl paper {tuned[recipe.name]} --recipe tuned"
    said = f"{recipe.name} {recipe.title}"
    network = next((each for each in networks() if each in said), "copper_net")
    return f"cirl train {network} --recipe {recipe.name}"


def _learners(recipe: Recipe) -> Iterator[tuple[str, ...]]:
    matches = ["all", *(_whom(match.model_dump(mode="json")) for match in recipe.match)]
    told = str(LearnerSettings.model_fields["scheme"].description)
    schemes = dict(each.split(": ") for each in told.split("; "))
    for whom, (_, learner) in zip(matches, recipe.learners(), strict=True):
        bootstrap = "yes" if learner.bootstrap else "no"
        yield whom, learner.algorithm, schemes[learner.scheme], learner.policy, bootstrap


def _whom(match: Mapping[str, Any]) -> str:
    said = [f"{key} {', '.join(value) if isinstance(value, list) else value}"
            for key in ("kind", "role", "agents") if (value := match[key])]  # fmt: skip
    return " and ".join(said) or "all"


def _settings(recipe: Recipe) -> Iterator[tuple[str, str]]:
    for key, value in recipe.run.model_dump(mode="json").items():
        yield f"`run.{key}`", _said(value)
    for key, value in recipe.environment.items():
        yield f"`environment.{key}`", _said(value)
    for where, learner in recipe.learners():
        yield from _parameters(where, learner)


def _parameters(where: str, learner: LearnerSettings) -> Iterator[tuple[str, str]]:
    for key, value in learner.normalise.model_dump(mode="json").items():
        yield f"`{where}.normalise.{key}`", _said(value)
    for key, value in learner.parameters.items():
        yield f"`{where}.parameters.{key}`", _said(value)
    more = learner.model_dump(mode="json", include={"share_of_steps", "start", "demonstrations"}, exclude_none=True)
    for key, value in more.items():
        yield f"`{where}.{key}`", _said(value)


def _said(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else json.dumps(value).strip('"')


def _results(name: str) -> Iterator[str]:
    """Yield what the study found of the recipe, network by network."""
    rows = []
    for path in sorted(STUDY.glob("*/summary.json")):
        found = json.loads(path.read_text(encoding="utf-8"))
        for row in found["rows"]:
            if row["name"] == name:
                check_study(path.parent.name)
                forms = (("circularity", "{:.4g}"), ("service", "{:.4f}"), ("gap", "{:.1%}"))
                figures = [interval(row[which], form) for which, form in forms]
                rows.append((f"[{path.parent.name}](../networks/{path.parent.name}.md)", len(row["seeds"]), *figures))
    if rows:
        yield "## What it reached"
        yield table(("network", "seeds", "λ̄", "mean service", "gap to the bound"), rows)
        yield "From the study of all recipes, with intervals over training seeds: [study.md](../docs/study.md)."
