"""A page for each compartment model, made from its class."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

from cirl_marl import load_network
from cirl_marl.compartments import kind_of, models
from cirl_marl.definitions.catalogue import families
from cirl_marl.network.compartment_model import (
    CompartmentModel,
    ContinuousModel,
    DiscreteTimeModel,
    MeasuringModel,
    OwnStepModel,
    ReleasingModel,
    Vehicle,
)
from cirl_marl.network.declarations import Quantity, declarations
from docs.site.markdown import ROOT, GeneratedPage, sections_about, table

MOTION = {
    ContinuousModel: "the solver of the network integrates its derivative",
    OwnStepModel: "it brings its own step",
    DiscreteTimeModel: "one step in each control interval",
}


def model_page(kind: str) -> GeneratedPage:
    """Return the page of a kind of compartment model."""
    found = models()[kind]
    model = found()
    moves = next(said for motion, said in MOTION.items() if isinstance(model, motion))
    source = f"cirl_marl/{found.__module__.removeprefix('cirl_marl.').replace('.', '/')}.py"
    parts = [
        f"# {kind}",
        _prose(found),
        f"It moves: {moves}. Its unit of time is the {model.time_unit}. Class: `{found.__module__}.{found.__name__}`, "
        f"[{source.rpartition('/')[2]}](../{source}).{_reasons(kind)}",
        "## States, inputs and what it measures",
        table(("name", "what", "lowest", "highest", "who sees it"), _rows(model)),
        *_parameters(found),
        "## Where it is used",
        *_used(kind),
    ]
    return GeneratedPage(f"models/{kind}.md", kind, "\n\n".join(parts) + "\n")


def _prose(found: type[Any]) -> str:
    """Return what the docstring says before it lists parameters."""
    return inspect.cleandoc(str(found.__doc__)).partition("\nAttributes:")[0].replace("``", "`").strip()


def _reasons(kind: str) -> str:
    links = sections_about(kind)
    return f" What was published, and what is mended: {' and '.join(links)}." if links else ""


def _rows(model: CompartmentModel) -> Iterator[tuple[str, ...]]:
    """Yield names, which end in their unit, and the bounds within which the equations hold."""
    for name in model.state_names:
        yield f"`{name}`", "state", *_bounds(model, name), "its agent" if name in model.observed_states else "nobody"
    for name in model.input_names:
        yield f"`{name}`", "input", *_bounds(model, name), ""
    if isinstance(model, MeasuringModel):
        for name in model.measure_names:
            yield f"`{name}`", "measure", "", "", "its agent, and services"
    if isinstance(model, ReleasingModel):
        for name in model.ports:
            yield f"`{name}`", "port of batches", "", "", ""
    if isinstance(model, Vehicle):
        yield "", "carries the batches of its arc", "", "", ""


def _bounds(model: CompartmentModel, name: str) -> tuple[str, str]:
    low, high = model.bounds.get(name, (-math.inf, math.inf))
    return ("" if math.isinf(low) else f"{low:g}", "" if math.isinf(high) else f"{high:g}")


def _parameters(found: type[Any]) -> Iterator[str]:
    """Yield the table of parameters, with defaults, bounds and what was said of them."""
    told = declarations(found)
    rows = []
    for each in fields(found):
        declared = told[each.name]
        low, high = (declared.low, declared.high) if isinstance(declared, Quantity) else (-math.inf, math.inf)
        least = "> 0" if isinstance(declared, Quantity) and declared.positive else f"≥ {low:g}" * math.isfinite(low)
        most = f"≤ {high:g}" if math.isfinite(high) else ""
        meaning = declared.meaning.replace("``", "`")
        rows.append((f"`{each.name}`", each.default, ", ".join(filter(None, (least, most))), meaning))
    yield "## Parameters"
    yield table(("name", "default", "must be", "what it is"), rows) if rows else "None."


def _used(kind: str) -> Iterator[str]:
    """Yield where the catalogue has the model: network, scenario and compartment."""
    rows = []
    for names in families().values():
        whole = load_network(names[0])
        if f'"{kind}"' not in str((ROOT / "envs" / f"{whole.source.stem}.toml").read_text(encoding="utf-8")):  # type: ignore[union-attr]
            continue
        for network in (whole, *whole.scenarios.values()):
            for compartment in network.compartments.values():
                if compartment.model is not None and kind_of(compartment.model) == kind:
                    place = f"[{names[0]}](../networks/{names[0]}.md)"
                    rows.append((place, network.scenario_name, f"`{compartment.id}`"))
    yield table(("network", "scenario", "compartment"), rows) if rows else "In no network of the catalogue."
