"""Tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.table import Table

from cirl_marl.network import Floats, Network
from cirl_marl.network.elements import Arc, Compartment, ControlKind, Law, Lifetime


def networks_table(networks: Mapping[str, Network]) -> Table:
    """One row a network, or a definition of several: compartments, agents, services, scenarios."""
    table = Table(title="Networks")
    _columns(table, "name", "what it is", "compartments", "agents", "services", "scenarios")
    for name, network in networks.items():
        services = ", ".join(service.id for service in network.services) or "none"
        scenarios = ", ".join([network.scenario_name, *network.scenarios])
        counts = str(len(network.compartments)), str(len(network.agents))
        table.add_row(name, network.title, *counts, services, scenarios)
    return table


def nodes_table(network: Network, stock: Floats) -> Table:
    """One row a node: role, stock at the start, set-point, control; those that store nothing have no stock."""
    table = Table(title=f"{network.title or network.name}: nodes ({network.mass_unit})")
    _columns(table, "node", "role", "initial range", "stock", "set-point", "control")
    for i, node in enumerate(network.nodes):
        span, held = "stores nothing", ""
        if node.stores:
            low, high = network.initial[:, i]
            span = f"{low:g}" if low == high else f"{low:g} – {high:g}"
            known = "left of its history" if node.history is not None else "all that is asked for"
            span, held = span if node.initial is not None else known, f"{stock[i]:.5g}"
        table.add_row(node.id, node.role.value, span, held, _target(node), control_text(network, node))
    return table


def arcs_table(network: Network, flow: Floats) -> Table:
    """One row an arc: law, flow at the start, its sign in λ, set-point, control."""
    table = Table(title=f"arcs ({network.mass_unit}/{network.time_unit})")
    _columns(table, "arc", "law", "flow", "in λ", "set-point", "control")
    signs = {1.0: "−", -1.0: "+", 0.0: ""}
    for k, arc in enumerate(network.arcs):
        sign = signs[float(network.sustainability[k])]
        table.add_row(arc.id, law_text(network, arc), f"{flow[k]:.5g}", sign, _target(arc), control_text(network, arc))
    return table


def _columns(table: Table, name: str, *others: str) -> None:
    table.add_column(name, no_wrap=True)
    for other in others:
        table.add_column(other, justify="right" if other in ("stock", "flow", "set-point") else "left")


def _target(compartment: Compartment) -> str:
    return "" if compartment.set_point is None else f"{compartment.set_point:g}"


def law_text(network: Network, arc: Arc) -> str:
    """Say the flow law of an arc as a formula."""
    if arc.law is Law.DONOR:
        return f"{arc.rate:g} x({arc.donor})"
    if arc.law is Law.RECIPIENT:
        return f"{arc.rate:g} x({arc.recipient})"
    if arc.law is Law.CONTROLLED:
        return f"u, makes up for {arc.makes_up_for}" if arc.makes_up_for else "u"
    if arc.law is Law.COMPARTMENT:
        return f"{arc.rate:g} y({arc.by})"
    if arc.law is Law.BATCH:
        what = f"{arc.rate:g} x {arc.port} of {arc.by}" if arc.by else f"{len(arc.batches)} on schedule"
        return f"batches: {what}, " + (f"after {arc.delay:g}" if arc.delay else "by vehicle")
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


def evaluation_table(figures: Mapping[str, Any]) -> Table:
    """One row a controller: λ̄, gain, service level with confidence intervals; returns as means over the agents."""
    table = Table(title=f"{figures['episodes']} fresh episodes, mean ± half-width of the 95 % confidence interval")
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
    shown = [which for which in columns if all(which in row for row in rows.values())]
    table.add_column("controller")
    for which in shown:
        table.add_column(columns[which][0], justify="right")
    for name, row in rows.items():
        table.add_row(name, *(_figure(row[which], columns[which][1]) for which in shown))
    return table


def local_returns_table(figures: Mapping[str, Any]) -> Table:
    """One row an agent: its local return under each controller."""
    table = Table(title="local return of each agent")
    controllers = figures["controllers"]
    table.add_column("agent")
    for name in controllers:
        table.add_column(name, justify="right")
    for agent in next(iter(controllers.values()))["local_return"]:
        table.add_row(agent, *(_figure(row["local_return"][agent], "{:.4g}") for row in controllers.values()))
    return table


def _figure(found: Mapping[str, Any], form: str) -> str:
    """Write a mean with the half-width of its interval, which is Student's and so symmetric; alone if it has none.

    Of figures by agent it is the mean over the agents.

    >>> _figure({"value": 0.25, "low": 0.2, "high": 0.3}, "{:+.1%}")
    '+25.0% ± 5.0%'
    """
    if set(found) != {"value", "low", "high"}:
        return form.format(np.mean([each["value"] for each in found.values()]))
    value, high = found["value"], found["high"]
    if value is None:
        return "–"
    if high is None:
        return form.format(value)
    return f"{form.format(value)} ± {form.format(high - value).lstrip('+')}"
