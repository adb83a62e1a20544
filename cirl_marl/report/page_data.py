"""A story as plain values, ready for JSON, which is all that the page in the browser knows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.definitions.sources import StatedNumber, stated_numbers
from cirl_marl.definitions.writer import fingerprint
from cirl_marl.drawing.flow_diagram import FlowDiagram, lines
from cirl_marl.drawing.grouping import flow_diagrams
from cirl_marl.errors import CirlError
from cirl_marl.evaluation.statistics import Aggregate
from cirl_marl.network import Floats, Network
from cirl_marl.network.calendar import labels
from cirl_marl.network.elements import Arc, Service
from cirl_marl.network.series import extremes
from cirl_marl.records.machine import versions
from cirl_marl.report.decisions import settings
from cirl_marl.report.report_page import PLAN, Band, PageEpisode, ReportPage
from cirl_marl.report.terminal import law_text

DIGITS = 6
"""Significant digits of every number on the page."""
SHOWN_VERSIONS = ("cirl-marl", "python", "numpy", "torch")


def page_data(story: ReportPage) -> dict[str, Any]:
    """Return everything that the page of ``story`` shows.

    Raises:
        CirlError: if there is nothing to show, or scenes differ in their units or times.
        DefinitionError: if the file of a network has changed since it was read.
    """
    if not story.scenes and not story.points:
        raise CirlError(f"network '{story.network.name}': there is nothing to show, neither episodes nor points")
    networks: list[Network] = []
    for scene in story.scenes:
        if scene.network not in networks:
            networks.append(scene.network)
    found = versions()
    return {
        "title": story.title,
        "name": story.network.name,
        "scenario": story.network.scenario_name,
        "material": story.network.material,
        "references": list(story.network.references),
        "mass": story.network.mass_unit,
        "time": story.network.time_unit,
        "interval": story.network.episode.control_interval,
        "clock": _clock(story.scenes),
        "networks": [_network(each, story) for each in networks],
        "scenes": [_scene(each, networks.index(each.network)) for each in story.scenes],
        "points": [
            {
                "name": each.name,
                "service": _number(each.service),
                "lambda": _number(each.circularity),
                "about": each.about,
            }
            for each in story.points
        ],
        "front": _rows(story.front),
        "notes": list(story.notes),
        "reasons": [{"title": heading, "said": list(said)} for heading, said in story.reasons],
        "made": {
            "versions": [f"{name} {found[name]}" for name in SHOWN_VERSIONS],
            "definition": fingerprint(story.network),
        },
    }


def _clock(scenes: Sequence[PageEpisode]) -> dict[str, Any]:
    """Return when each interval begins and ends, and what it is called; the same for all scenes."""
    if not scenes:
        return {"from": [], "to": [], "labels": [], "calendar": ""}
    for scene in scenes[1:]:
        ours, theirs = scenes[0].network, scene.network
        if len(scene.flow) != len(scenes[0].flow) or ours.episode.control_interval != theirs.episode.control_interval:
            raise CirlError(
                f"'{scenes[0].name}' has {len(scenes[0].flow)} intervals of {ours.episode.control_interval:g} "
                f"{ours.time_unit}, '{scene.name}' {len(scene.flow)} of {theirs.episode.control_interval:g}: a page "
                "shows them by one clock; give a number of steps for both, or write two pages"
            )
    network = scenes[0].network
    ends = interval_ends(network)
    begins = ends - network.episode.control_interval
    calendar, dates = labels(network, begins)
    named = dates[0] if dates else [f"{network.time_unit} {each:.6g}" for each in ends.tolist()]
    return {"from": _list(begins), "to": _list(ends), "labels": named, "calendar": calendar[0] if calendar else ""}


def _network(network: Network, story: ReportPage) -> dict[str, Any]:
    scenes = [each for each in story.scenes if each.network == network]
    peaks = np.max([np.abs(np.nan_to_num(each.flow)).max(axis=0) for each in scenes], axis=0)
    told = stated_numbers(network)
    nodes = [
        {
            "id": node.id,
            "label": node.label,
            "role": node.role.value,
            "stores": node.stores,
            "scale": _number(node.scale),
            "told": _told(told["nodes"].get(node.id, ())),
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
            "law": _law(network, arc),
            "told": _told(told["arcs"].get(arc.id, ())),
        }
        for k, arc in enumerate(network.arcs)
    ]
    services = [_service(network, each, told["services"].get(each.id, ())) for each in network.services]
    agents = scenes[0].agents
    low, neutral, high = network.control_bounds
    controls = [
        {
            "agent": each.agent,
            "name": each.name,
            "kind": each.kind.value,
            "of": each.of,
            "unit": each.unit,
            "row": each.row,
            "low": _short(low[each.row]),
            "neutral": _short(neutral[each.row]),
            "high": _short(high[each.row]),
        }
        for each in settings(network, agents)
    ]
    drawn = [_sketch(each) for each in flow_diagrams(network, peaks)]
    return {"nodes": nodes, "arcs": arcs, "services": services, "settings": controls, "sketches": drawn}


def _law(network: Network, arc: Arc) -> str:
    return f"Law {arc.law.value}" + ("" if arc.id in network.time_dependent else f": {law_text(network, arc)}")


def _service(network: Network, service: Service, told: Iterable[StatedNumber]) -> dict[str, Any]:
    label = service.title or service.id.replace("_", " ")
    providers = ", ".join(network.compartments[each].label for each in service.providers)
    measured = f"{service.measure or service.quantity} of {providers}"
    low, high = extremes(service.low)
    return {
        "id": service.id, "label": label, "measured": measured, "low": _number(low), "high": _number(high),
        "told": _told(told),
    }  # fmt: skip


def _told(found: Iterable[StatedNumber]) -> list[list[str]]:
    return [[each.key, each.value, each.source] for each in found]


def _scene(scene: PageEpisode, network: int) -> dict[str, Any]:
    found = scene.network
    start = np.full(len(found.stores), np.nan) if scene.start is None else scene.start
    stock = np.concatenate([start[None], scene.stock])
    levels = [*stock.T, *found.throughput(scene.flow.T)]
    return {
        "name": scene.name,
        "plan": scene.name in (PLAN, "optimum"),
        "network": network,
        "scenario": found.scenario_name,
        "levels": [_list(each) for each in levels],
        "flows": [_list(each) for each in scene.flow.T],
        "controls": None if scene.controls is None else [_list(each) for each in scene.controls.T],
        "lambda": _band(scene.circularity),
        "services": [_band(each) for each in scene.levels],
        "about": scene.about,
        "figures": {name: _aggregate(each) for name, each in scene.figures.items() if each is not None},
    }


def _sketch(drawn: FlowDiagram) -> dict[str, Any]:
    ways = {
        way: {
            "scale": drawn.scales[way],
            "breadth": _pixels(weave.breadth),
            "boxes": [
                [int(layer), _pixels(middle), _pixels(breadth)]
                for layer, middle, breadth in zip(weave.layers, weave.middles, drawn.breadths[way], strict=True)
            ],
            "labels": [list(lines(box.label, way)) for box in drawn.boxes],
            "courses": [
                {"lane": _pixels(each.lane), "side": each.side}
                if each.side
                else {"via": [_pixels(at) for at in each.via]} | ({"back": True} if each.back else {})
                for each in weave.routes
            ],
        }
        for way, weave in drawn.layouts.items()
    }
    boxes = [
        {"label": box.label, "members": list(box.members), "role": box.role.value, "stores": box.stores,
         "opens": box.opens}
        for box in drawn.boxes
    ]  # fmt: skip
    ribbons = [
        {"members": list(each.members), "donor": each.donor, "recipient": each.recipient} for each in drawn.ribbons
    ]
    return {"group": drawn.group, "caption": drawn.caption, "boxes": boxes, "ribbons": ribbons, "ways": ways}


def _band(band: Band) -> dict[str, Any]:
    ends = {name: values for name, values in (("low", band.low), ("high", band.high)) if values is not None}
    return {"value": _list(band.value), **{name: _list(values) for name, values in ends.items()}}


def _aggregate(found: Aggregate) -> list[float | None]:
    return [_number(each) for each in (found.value, found.low, found.high)]


def _short(values: Floats) -> float | list[float | None] | None:
    """Return a series, or its only value if it never changes."""
    return _number(values[0]) if np.ptp(values) == 0 else _list(values)


def _rows(values: Floats) -> list[list[float | None]]:
    return [_list(row) for row in values]


def _list(values: Floats) -> list[float | None]:
    return [_number(each) for each in values.tolist()]


def _number(value: float) -> float | None:
    """Round to what is shown; whole numbers are short; None stands for what is no number."""
    if not math.isfinite(value):
        return None
    rounded = float(f"{value:.{DIGITS}g}")
    return int(rounded) if rounded.is_integer() and abs(rounded) < 2**53 else rounded


def _pixels(value: float) -> float:
    return round(float(value), 1)
