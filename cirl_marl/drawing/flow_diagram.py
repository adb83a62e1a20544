"""Plans of flow diagrams: boxes and ribbons with their places, lying for wide screens and standing for narrow ones."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cirl_marl.drawing.layered import LayeredLayout, layered_layout
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.elements import Role

HORIZONTAL, VERTICAL = "lying", "standing"
WIDEST = {HORIZONTAL: 110.0, VERTICAL: 96.0}
WIDEST_OF_MANY = {HORIZONTAL: 84.0, VERTICAL: 60.0}
CROWD = 16
"""Breadth of the most that passes through a box, pixels, and with more boxes than ``CROWD``."""
LEAST = {HORIZONTAL: 20.0, VERTICAL: 72.0}
"""Least breadth of a box; a standing one holds its label."""
CLEARANCE = {HORIZONTAL: 14.0, VERTICAL: 10.0}
LETTERS = {HORIZONTAL: 13, VERTICAL: 10}
"""Of a line of a label."""
LINE = 12.5
"""Height of a line, pixels."""


@dataclass(frozen=True, slots=True)
class Box:
    """One compartment, or a group of them: ``members`` are its nodes, of a group those with a stock.

    ``opens`` names the group; it is empty for a compartment.
    """

    label: str
    members: tuple[int, ...]
    role: Role
    stores: bool
    opens: str = ""


@dataclass(frozen=True, slots=True)
class Ribbon:
    """One flow, or all those between two groups: ``members`` are its arcs; the ends are places among the boxes."""

    members: tuple[int, ...]
    donor: int
    recipient: int


@dataclass(frozen=True, slots=True)
class FlowDiagram:
    """A flow diagram without its numbers.

    Attributes:
        group: whose inside it shows; empty for the whole.
        boxes: what is drawn.
        ribbons: what runs between.
        weaves: places, lying and standing.
        breadths: of the boxes alone, shape (boxes,), by the same names.
        scales: pixels for a flow of 1, by the same names.
        caption: breadth kept for the label of a box that lies.
    """

    group: str
    boxes: tuple[Box, ...]
    ribbons: tuple[Ribbon, ...]
    layouts: Mapping[str, LayeredLayout]
    breadths: Mapping[str, Floats]
    scales: Mapping[str, float]
    caption: float


def flow_diagram(network: Network, peaks: Floats) -> FlowDiagram:
    """Return the diagram of a whole network of which arcs carry at most ``peaks``, shape (arcs,), mass/time."""
    boxes = [Box(node.label, (i,), node.role, node.stores) for i, node in enumerate(network.nodes)]
    ends = zip(network.donors.tolist(), network.recipients.tolist(), strict=True)
    return arrange_boxes(
        "", boxes, [Ribbon((k,), donor, recipient) for k, (donor, recipient) in enumerate(ends)], peaks
    )


def arrange_boxes(
    group: str, boxes: list[Box], ribbons: list[Ribbon], peaks: Floats, layers: Integers | None = None
) -> FlowDiagram:
    """Find the places of boxes and ribbons whose arcs carry at most ``peaks``; in ``layers``, if they are given."""
    most = np.array([peaks[list(ribbon.members)].sum() for ribbon in ribbons])
    donors, recipients = (np.array([getattr(r, end) for r in ribbons], dtype=np.intp) for end in ("donor", "recipient"))
    caption = LINE * (1 + max((len(lines(box.label, HORIZONTAL)) for box in boxes), default=0))
    weaves, breadths, scales = {}, {}, {}
    for way in (HORIZONTAL, VERTICAL):
        through = _through(len(boxes), donors, recipients, most)
        widest = (WIDEST if len(boxes) <= CROWD else WIDEST_OF_MANY)[way]
        scales[way] = widest / max(float(through.max(initial=0.0)), 1e-300)
        breadths[way] = np.maximum(scales[way] * through, LEAST[way])
        whole = breadths[way] + (caption if way == HORIZONTAL else 0.0)
        weaves[way] = layered_layout(donors, recipients, scales[way] * most, whole, CLEARANCE[way], layers)
    return FlowDiagram(group, tuple(boxes), tuple(ribbons), weaves, breadths, scales, caption)


def lines(label: str, way: str) -> tuple[str, ...]:
    """Break a label into lines at its spaces."""
    return tuple(textwrap.wrap(label, LETTERS[way], break_long_words=False, break_on_hyphens=False)) or ("",)


def _through(count: int, donors: Integers, recipients: Integers, most: Floats) -> Floats:
    """Return the most that enters or leaves each box, shape (boxes,)."""
    return np.maximum(np.bincount(donors, most, count), np.bincount(recipients, most, count))
