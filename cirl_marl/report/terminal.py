"""Tables for the terminal."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table

from cirl_marl.definitions.conversion import REGION
from cirl_marl.definitions.reader import Definition
from cirl_marl.network import Floats, Network
from cirl_marl.network.elements import Arc, Compartment, ControlKind, Law, Lifetime


def text_table(
    title: str,
    headings: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    text: Collection[str],
    unbroken: Collection[str] = (),
) -> Table:
    """Return a table for the terminal: columns of ``text`` stand left, others right; ``unbroken`` ones never wrap."""
    table = Table(title=title)
    for heading in headings:
        table.add_column(heading, justify="left" if heading in text else "right", no_wrap=heading in unbroken)
    for row in rows:
        table.add_row(*row)
    return table


def networks_table(definitions: Mapping[str, Definition], *, all_regions: bool = False) -> Table:
    """One row a definition, or with ``all_regions`` one a region: compartments, agents, services, scenarios.

    They are counted in what the definition says: no network is built, which takes seconds.
    """
    headings = ["name", "what it is", "compartments", "agents", "services", "scenarios"]
    rows = []
    for name, definition in definitions.items():
        document, regions = definition.document(), definition.regions
        compartments = [*document["nodes"].values(), *document.get("arcs", {}).values()]
        agents = document.get("agents") or [part for part in compartments if "control" in part]
        services = [*document.get("services", {})] or ["none"]
        more = [f"{len(services) - 2} more"] if len(services) > 2 else []
        cells = [str(len(compartments)), str(len(agents)), ", ".join(services[:2] + more), ", ".join(definition.names)]
        names = {f"{name}_{region}": text for region, text in regions.items()} or {name: ""}
        if regions and not all_regions:
            names = {f"{name}_* ({len(regions)} regions)": "a region"}
        rows += [[label, document["title"].replace(REGION, text), *cells] for label, text in names.items()]
    return text_table("Networks", headings, rows, text=headings, unbroken=["name"])


def nodes_table(network: Network, stock: Floats) -> Table:
    """One row a node: role, stock at the start, set-point, control; those that store nothing have no stock."""
    rows = []
    for i, node in enumerate(network.nodes):
        span, amount = "stores nothing", ""
        if node.stores:
            low, high = network.initial[:, i]
            span, amount = f"{low:g}" if low == high else f"{low:g} – {high:g}", f"{stock[i]:.5g}"
        if node.stores and node.initial is None:
            span = "left of its history" if node.history is not None else "all that is asked for"
        rows.append([node.id, node.role.value, span, amount, _set_point(node), control_text(network, node)])
    headings = ["node", "role", "initial range", "stock", "set-point", "control"]
    title = f"{network.title or network.name}: nodes ({network.mass_unit})"
    return text_table(title, headings, rows, text=["node", "role", "initial range", "control"], unbroken=["node"])


def arcs_table(network: Network, flow: Floats) -> Table:
    """One row an arc: law, flow at the start, its sign in λ, set-point, control."""
    signs = {1.0: "−", -1.0: "+", 0.0: ""}
    rows = []
    for arc, amount, sustainability in zip(network.arcs, flow, network.sustainability.tolist(), strict=True):
        figures = [f"{amount:.5g}", signs[sustainability], _set_point(arc)]
        rows.append([arc.id, law_text(network, arc), *figures, control_text(network, arc)])
    headings, title = ["arc", "law", "flow", "in λ", "set-point", "control"], f"{network.mass_unit}/{network.time_unit}"
    return text_table(f"arcs ({title})", headings, rows, text=["arc", "law", "in λ", "control"], unbroken=["arc"])


def _set_point(compartment: Compartment) -> str:
    return "" if compartment.set_point is None else f"{compartment.set_point:g}"


def law_text(network: Network, arc: Arc) -> str:
    """Say the flow law of an arc as a formula."""
    if arc.law is Law.DONOR:
        return f"{arc.rate:g} x({arc.donor})"
    if arc.law is Law.RECIPIENT:
        return f"{arc.rate:g} x({arc.recipient})"
    if arc.law is Law.CONTROLLED:
        if arc.capacity_node:
            return f"u ≤ {arc.capacity_rate:g} x({arc.capacity_node})"
        return f"u, makes up for {arc.makes_up_for}" if arc.makes_up_for else "u"
    if arc.law is Law.COMPARTMENT:
        return f"{arc.rate:g} y({arc.by})"
    if arc.law is Law.BATCH:
        amount = f"{arc.rate:g} x {arc.port} of {arc.by}" if arc.by else f"{len(arc.batches)} on schedule"
        return f"batches: {amount}, " + (f"after {arc.delay:g}" if arc.delay else "by vehicle")
    if arc.law is Law.SHARE:
        donor = network.nodes[network.node_index[arc.donor]]
        share = "s" if arc.control else "rest" if arc.share is None else f"{arc.share:g}"
        if donor.lifetime is not None:
            return f"{share} of what {lifetime_text(donor.lifetime)} in {donor.id} lets go"
        return f"{share} of {donor.rate:g} x({donor.id})" if donor.stores else f"{share} of {donor.id}"
    return f"{arc.flow:g}"


def lifetime_text(lifetime: Lifetime) -> str:
    """Say a lifetime: its mean, its deviation and its distribution."""
    spread = f" ± {lifetime.deviation:g}" if lifetime.deviation is not None else ""
    return f"a {lifetime.distribution.replace('_', ' ')} lifetime of {lifetime.mean:g}{spread}"


def control_text(network: Network, compartment: Compartment) -> str:
    """Say what an agent sets: bounds, with the neutral value between them; empty if the compartment does not act.

    What makes up for a service while nobody acts has its bounds, too.
    """
    control = compartment.control
    supplies = isinstance(compartment, Arc) and bool(compartment.makes_up_for)
    if control is None or not (compartment.id in network.agents or supplies):
        return ""
    bounds = f"{control.low:g} | {control.neutral:g} | {control.high:g}"
    if control.kind is ControlKind.INPUT and compartment.model is not None:
        return f"{', '.join(compartment.model.input_names)}: {bounds}"
    unit = f" {network.mass_unit}/{network.time_unit}" if control.kind is ControlKind.FLOW else ""
    return f"{control.kind.value} {bounds}{unit}"


def disturbances_table(network: Network) -> Table:
    """One row a disturbance that disturbs something: its kind, ends, who sees it, and what it disturbs."""
    rows = []
    for name, part in zip(network.processes.names, network.processes.disturbances, strict=True):
        low, high = part.ends
        seen = f"{part.delayed} late" if part.delayed else f"{part.forecast} ahead" if part.forecast else part.observed
        seen += f", by {', '.join(part.observed_by)}" if part.observed_by else ""
        places = [path for path, effect in network.disturbed.items() if effect.by == name]
        values = f"{low:.4g} … {high:.4g} {'' if part.unit == '1' else part.unit}"
        rows.append([name, part.kind, values, seen, "\n".join(places)])
    headings = ["disturbance", "kind", "values", "seen", "disturbs"]
    return text_table("", headings, rows, text=["disturbance", "kind", "seen", "disturbs"])


def evaluation_table(figures: Mapping[str, Any]) -> Table:
    """One row a controller: λ̄, gain, service level with confidence intervals; returns as means over the agents."""
    unit, rows = figures["unit"], figures["controllers"]
    columns = {
        "circularity": (f"λ̄ ({unit})", "{:.4g}"),
        "circularity_gain": ("gain over neutral", "{:+.1%}"),
        "service_level": ("service level", "{:.4f}"),
        "return": ("return", "{:.4g}"),
        "local_return": ("local return", "{:.4g}"),
        "gap": ("gap to bound", "{:.1%}"),
        "time_window_circularity": (f"weighted, time window ({unit})", "{:.4g}"),
    }
    common = [name for name in columns if all(name in row for row in rows.values())]
    cells = ([name, *(_figure(row[key], columns[key][1]) for key in common)] for name, row in rows.items())
    title = f"{figures['episodes']} fresh episodes, mean ± half-width of the 95 % confidence interval"
    return text_table(title, ["controller", *(columns[name][0] for name in common)], cells, text=["controller"])


def local_returns_table(figures: Mapping[str, Any]) -> Table:
    """One row an agent: its local return under each controller."""
    returns = {name: row["local_return"] for name, row in figures["controllers"].items()}
    agents = next(iter(returns.values()))
    rows = ([agent, *(_figure(of_agent[agent], "{:.4g}") for of_agent in returns.values())] for agent in agents)
    return text_table("local return of each agent", ["agent", *returns], rows, text=["agent"])


def _figure(aggregate: Mapping[str, Any], form: str) -> str:
    """Write a mean with the half-width of its interval, which is Student's and so symmetric; alone if it has none.

    Of figures by agent it is the mean over the agents.

    >>> _figure({"value": 0.25, "low": 0.2, "high": 0.3}, "{:+.1%}")
    '+25.0% ± 5.0%'
    """
    if set(aggregate) != {"value", "low", "high"}:
        return form.format(np.mean([agent["value"] for agent in aggregate.values()]))
    value, high = aggregate["value"], aggregate["high"]
    if value is None:
        return "–"
    margin = "" if high is None else f" ± {form.format(high - value).lstrip('+')}"
    return form.format(value) + margin
