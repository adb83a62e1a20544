"""A report page as plain values, ready for JSON, which is all that the page in the browser knows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, astuple
from typing import Any

import numpy as np

from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.definitions.sources import StatedNumber, stated_numbers
from cirl_marl.definitions.writer import fingerprint
from cirl_marl.drawing.content_colours import ContentColours
from cirl_marl.drawing.flow_diagram import LETTERS, FlowDiagram, flow_diagrams
from cirl_marl.drawing.layered import RibbonRoute
from cirl_marl.drawing.style import label_lines, readable
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Network
from cirl_marl.network.calendar import labels
from cirl_marl.network.elements import Service
from cirl_marl.network.series import extremes
from cirl_marl.records.machine import versions
from cirl_marl.report.decisions import settings
from cirl_marl.report.report_page import PLAN, Band, PageEpisode, ReportPage
from cirl_marl.report.terminal import law_text

DIGITS = 6
"""Significant digits of every number on the page."""
SHOWN_VERSIONS = ("cirl-marl", "python", "numpy", "torch")
Values = dict[str, Any]


def page_data(page: ReportPage) -> Values:
    """Return everything that ``page`` shows.

    Raises:
        CirlError: if there is nothing to show, or episodes differ in their units or times.
        DefinitionError: if the file of a network has changed since it was read.
    """
    network = page.network
    if not page.episodes and not page.points:
        raise CirlError(f"network '{network.name}': there is nothing to show, neither episodes nor points")
    networks: list[Network] = []
    for episode in page.episodes:
        if episode.network not in networks:
            networks.append(episode.network)
    packages = versions()
    return {
        "title": page.title,
        "name": network.name,
        "scenario": network.scenario_name,
        "material": network.material,
        "references": list(network.references),
        "mass": network.mass_unit,
        "time": network.time_unit,
        "interval": network.episode.control_interval,
        "clock": _clock(page.episodes),
        "networks": [_network(of_page, [e for e in page.episodes if e.network == of_page]) for of_page in networks],
        "scenes": [_episode(episode, networks.index(episode.network)) for episode in page.episodes],
        "points": [
            {"name": p.name, "service": _number(p.service), "lambda": _number(p.circularity), "about": p.about}
            for p in page.points
        ],
        "front": [_list(row) for row in page.front],
        "notes": list(page.notes),
        "reasons": [{"title": heading, "said": list(sentences)} for heading, sentences in page.reasons],
        "made": {
            "versions": [f"{name} {packages[name]}" for name in SHOWN_VERSIONS],
            "definition": fingerprint(network),
        },
    }


def _clock(episodes: Sequence[PageEpisode]) -> Values:
    """Return when each interval begins and ends, and what it is called; the same for all episodes."""
    if not episodes:
        return {"from": [], "to": [], "labels": [], "calendar": ""}
    first, network = episodes[0], episodes[0].network
    interval = network.episode.control_interval
    for episode in episodes[1:]:
        length = episode.network.episode.control_interval
        if (len(episode.rollout.flow), length) != (len(first.rollout.flow), interval):
            clocks = (
                f"'{first.name}' has {len(first.rollout.flow)} intervals of {interval:g} {network.time_unit}, "
                f"'{episode.name}' {len(episode.rollout.flow)} of {length:g}"
            )
            remedy = "give a number of steps for both, or write two pages"
            raise CirlError(f"{clocks}: a page shows them by one clock; {remedy}")
    ends = interval_ends(network)
    calendar, dates = labels(network, ends - interval)
    names = dates[0] if dates else [f"{network.time_unit} {time:.6g}" for time in ends.tolist()]
    return {"from": _list(ends - interval), "to": _list(ends), "labels": names, "calendar": "".join(calendar[:1])}


def _network(network: Network, episodes: Sequence[PageEpisode]) -> Values:
    peaks = np.max([np.abs(np.nan_to_num(episode.rollout.flow)).max(axis=0) for episode in episodes], axis=0)
    sources, changing = stated_numbers(network), network.time_dependent
    nodes = [
        {
            "id": node.id,
            "label": node.label,
            "role": node.role.value,
            "stores": node.stores,
            "scale": _number(node.scale),
            "told": _sources(sources["nodes"].get(node.id, ())),
        }
        for node in network.nodes
    ]
    arcs = [
        {
            "id": arc.id,
            "label": arc.label,
            "donor": int(network.donors[k]),
            "recipient": int(network.recipients[k]),
            "sign": -int(network.sustainability[k]),
            "law": f"Law {arc.law.value}" + ("" if arc.id in changing else f": {law_text(network, arc)}"),
            "told": _sources(sources["arcs"].get(arc.id, ())),
        }
        for k, arc in enumerate(network.arcs)
    ]
    ends = dict(zip(("low", "neutral", "high"), network.control_bounds, strict=True))
    controls = [
        {"agent": s.agent, "name": s.name, "kind": s.kind.value, "of": s.of, "unit": s.unit, "row": s.row}
        | {name: _series(values[s.row]) for name, values in ends.items()}
        for s in settings(network, episodes[0].agents)
    ]
    return {
        "nodes": nodes,
        "arcs": arcs,
        "services": [_service(network, s, sources["services"].get(s.id, ())) for s in network.services],
        "disturbances": [
            {"id": name, "unit": part.unit}
            for name, part in zip(network.processes.names, network.processes.disturbances, strict=True)
        ],
        "accounts": [
            {"id": part.id, "label": part.title or part.id.replace("_", " "), "unit": part.unit}
            for part in network.accounts
        ],
        "substances": [_substance(network, i, episodes) for i in range(len(network.substances))],
        "settings": controls,
        "sketches": [_diagram(diagram) for diagram in flow_diagrams(network, peaks)],
    }


def _substance(network: Network, place: int, episodes: Sequence[PageEpisode]) -> Values:
    """Return a substance with the scale of its colours, that of all episodes together."""
    id_, nodes = network.substances[place].id, len(network.nodes)
    runs = [episode.rollout for episode in episodes if len(episode.rollout.contents)]
    flow = np.concatenate([run.flow.ravel() for run in runs] or [np.empty(0)])
    contents = np.concatenate([run.contents[:, place, nodes:].ravel() for run in runs] or [np.empty(0)])
    colours = ContentColours(readable(id_), contents, flow)
    steps = [[colour, text] for colour, text in colours.steps.items()]
    return {"id": id_, "label": readable(id_), "highest": _number(colours.highest), "steps": steps}


def _service(network: Network, service: Service, sources: Iterable[StatedNumber]) -> Values:
    providers = ", ".join(network.compartments[provider].label for provider in service.providers)
    low, high = extremes(service.low)
    return {
        "id": service.id,
        "label": service.title or service.id.replace("_", " "),
        "measured": f"{service.subject} of {providers}",
        "low": _number(low),
        "high": _number(high),
        "told": _sources(sources),
    }


def _sources(numbers: Iterable[StatedNumber]) -> list[list[str]]:
    return [[number.key, number.value, number.source] for number in numbers]


def _episode(episode: PageEpisode, network: int) -> Values:
    run, throughput = episode.rollout, episode.network.throughput(episode.rollout.flow.T)
    contents = run.contents.swapaxes(0, 1) if len(run.contents) else ()
    return {
        "name": episode.name,
        "plan": episode.name in (PLAN, "optimum"),
        "network": network,
        "scenario": episode.network.scenario_name,
        "levels": [_list(row) for row in (*np.vstack([run.start, run.stock]).T, *throughput)],
        "flows": [_list(row) for row in run.flow.T],
        "controls": [_list(row) for row in run.controls.T] if len(run.controls) else None,
        "lambda": _band(episode.bands["circularity"][0]),
        "services": [*map(_band, episode.bands["service"])],
        "disturbances": [*map(_band, episode.bands["disturbance"])],
        "accounts": [*map(_band, episode.bands["account"])],
        "contents": [[_list(row) for row in part.T] for part in contents],
        "about": episode.about,
        "figures": {name: [*map(_number, astuple(f))] for name, f in episode.figures.items() if f is not None},
    }


def _diagram(diagram: FlowDiagram) -> Values:
    layouts = {
        name: {
            "scale": diagram.scales[name],
            "breadth": _pixels(layout.breadth),
            "boxes": [
                [int(layer), _pixels(middle), _pixels(breadth)]
                for layer, middle, breadth in zip(layout.layers, layout.middles, diagram.breadths[name], strict=True)
            ],
            "labels": [list(label_lines(box.label, LETTERS[name])) for box in diagram.boxes],
            "courses": [_route(route) for route in layout.routes],
        }
        for name, layout in diagram.layouts.items()
    }
    boxes, ribbons = ([asdict(part) for part in parts] for parts in (diagram.boxes, diagram.ribbons))
    return {"group": diagram.group, "caption": diagram.caption, "boxes": boxes, "ribbons": ribbons, "ways": layouts}


def _route(route: RibbonRoute) -> Values:
    if route.side:
        return {"lane": _pixels(route.lane), "side": route.side}
    via: Values = {"via": [_pixels(place) for place in route.via]}
    return via | ({"back": True} if route.back else {})


def _band(band: Band) -> Values:
    curves = {"value": band.value, "low": band.low, "high": band.high}
    return {name: _list(values) for name, values in curves.items() if values is not None}


def _series(values: Floats) -> float | list[float | None] | None:
    """Return a series, or its only value if it never changes."""
    return _number(values[0]) if np.ptp(values) == 0 else _list(values)


def _list(values: Floats) -> list[float | None]:
    return [_number(value) for value in values.tolist()]


def _number(value: float) -> float | None:
    """Round to what is shown; whole numbers are short; None stands for what is no number."""
    if not math.isfinite(value):
        return None
    short = float(f"{value:.{DIGITS}g}")
    return int(short) if short.is_integer() and abs(short) < 2**53 else short


def _pixels(value: float) -> float:
    return round(float(value), 1)
