"""Flow diagrams: boxes and ribbons with their places, lying for wide screens and standing for narrow ones.

Large networks are folded by group: one diagram shows the groups and what runs between, others the inside of each.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from cirl_marl.drawing.layered import LayeredLayout, layered_layout
from cirl_marl.drawing.style import label_lines, readable
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import positional_record
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
FOLDED_NODES = 60
"""Networks with more nodes open folded, if their titles tell groups."""
LEAST_GROUPS, LEAST_MEMBERS = 3, 4
MARK = ": "
"""What stands between the group and the rest of a title, as in ``Japan: Scrap``."""


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


@positional_record
class FlowDiagram:
    """A flow diagram without its numbers; places, breadths and scales are by ``HORIZONTAL`` and ``VERTICAL``."""

    group: Annotated[str, "whose inside it shows; empty for the whole"]
    boxes: Annotated[tuple[Box, ...], "what is drawn"]
    ribbons: Annotated[tuple[Ribbon, ...], "what runs between"]
    layouts: Annotated[Mapping[str, LayeredLayout], "places of boxes and ribbons"]
    breadths: Annotated[Mapping[str, Floats], "of the boxes alone, shape (boxes,)"]
    scales: Annotated[Mapping[str, float], "pixels for a flow of 1"]
    caption: Annotated[float, "breadth kept for the label of a box that lies"]


def arrange_boxes(
    group: str, boxes: list[Box], ribbons: list[Ribbon], peaks: Floats, layers: Integers | None = None
) -> FlowDiagram:
    """Find the places of boxes and ribbons whose arcs carry at most ``peaks``; in ``layers``, if they are given."""
    most = np.array([peaks[list(ribbon.members)].sum() for ribbon in ribbons])
    donors, recipients = (np.array([getattr(r, end) for r in ribbons], dtype=np.intp) for end in ("donor", "recipient"))
    caption = LINE * (1 + max((len(label_lines(box.label, LETTERS[HORIZONTAL])) for box in boxes), default=0))
    through = np.maximum(*(np.bincount(ends, most, len(boxes)) for ends in (donors, recipients)))
    weaves, breadths, scales = {}, {}, {}
    for way in (HORIZONTAL, VERTICAL):
        widest = (WIDEST if len(boxes) <= CROWD else WIDEST_OF_MANY)[way]
        scales[way] = widest / max(float(through.max(initial=0.0)), 1e-300)
        breadths[way] = np.maximum(scales[way] * through, LEAST[way])
        whole = breadths[way] + (caption if way == HORIZONTAL else 0.0)
        weaves[way] = layered_layout(donors, recipients, scales[way] * most, whole, CLEARANCE[way], layers)
    return FlowDiagram(group, tuple(boxes), tuple(ribbons), weaves, breadths, scales, caption)


def groups(network: Network) -> Mapping[str, list[int]]:
    """Return the nodes of each group, by its name; none of a network without.

    Groups are the copies of a network that is made of copies (``copies``, ids of nodes by name). Else, of a large one,
    they are what titles of nodes have before a colon, if four or more share it.
    """
    copies: Mapping[str, Sequence[str]] = network.copies
    if copies:
        return {readable(name).title(): [network.node_index[id_] for id_ in ids] for name, ids in copies.items()}
    by_title: dict[str, list[int]] = defaultdict(list)
    for i, node in enumerate(network.nodes):
        name, mark, _ = node.label.partition(MARK)
        if mark:
            by_title[name].append(i)
    large = {name: members for name, members in by_title.items() if len(members) >= LEAST_MEMBERS}
    return large if len(network.nodes) > FOLDED_NODES and len(large) >= LEAST_GROUPS else {}


def flow_diagrams(network: Network, peaks: Floats) -> list[FlowDiagram]:
    """Return the diagrams of a network whose arcs carry at most ``peaks``, shape (arcs,), mass/time.

    There is one, or of a network with ``groups`` one of these and one of the inside of each.
    """
    if members := groups(network):
        return [_diagram(network, members, name, peaks) for name in ("", *members)]
    boxes = [Box(node.label, (i,), node.role, node.stores) for i, node in enumerate(network.nodes)]
    ends = zip(network.donors.tolist(), network.recipients.tolist(), strict=True)
    ribbons = [Ribbon((k,), donor, recipient) for k, (donor, recipient) in enumerate(ends)]
    return [arrange_boxes("", boxes, ribbons, peaks)]


def _diagram(network: Network, members: Mapping[str, list[int]], name: str, peaks: Floats) -> FlowDiagram:
    """Return the diagram with one group unfolded and of the rest only what it has to do with; without a name, all."""
    inside = set(members.get(name, ()))
    group = {i: title for title, nodes in members.items() if title != name for i in nodes}
    ends = list(zip(network.donors.tolist(), network.recipients.tolist(), strict=True))
    near = set(range(len(network.nodes)))
    if name:
        near = {i for pair in ends if inside & set(pair) for i in pair}
        near |= {i for title in {group[i] for i in near if i in group} for i in members[title]}
    boxes: list[Box] = []
    box_of: dict[int, int] = {}
    for i in sorted(near):
        node, folded_in = network.nodes[i], group.get(i, "")
        if i in box_of:
            continue
        if folded_in:
            box_of |= dict.fromkeys(members[folded_in], len(boxes))
            stores = tuple(k for k in members[folded_in] if network.nodes[k].stores)
            boxes.append(Box(folded_in, stores, Role.TECHNOSPHERE, bool(stores), opens=folded_in))
        else:
            box_of[i] = len(boxes)
            boxes.append(Box(node.label.removeprefix(f"{name}{MARK}"), (i,), node.role, node.stores))
    between: dict[tuple[int, int], list[int]] = defaultdict(list)
    for k, (donor, recipient) in enumerate(ends):
        if donor not in box_of or recipient not in box_of or (name and not inside & {donor, recipient}):
            continue
        if box_of[donor] != box_of[recipient]:
            between[box_of[donor], box_of[recipient]].append(k)
    ribbons = [Ribbon(tuple(arcs), *pair) for pair, arcs in between.items()]
    layers = None if name else _around_markets(boxes, ribbons, peaks)
    return arrange_boxes(name, boxes, ribbons, peaks, layers)


def _around_markets(boxes: Sequence[Box], ribbons: Sequence[Ribbon], peaks: Floats) -> Integers | None:
    """Return layers in which markets stand between who gives them more and who takes more, shape (boxes,).

    Markets are the boxes through which groups trade. None, where groups trade with each other too.
    """
    ends = [(ribbon.donor, ribbon.recipient) for ribbon in ribbons]
    near: dict[int, set[int]] = defaultdict(set)
    for donor, recipient in ends:
        near[donor].add(recipient)
        near[recipient].add(donor)
    markets = {i for i, box in enumerate(boxes) if not box.opens and sum(bool(boxes[k].opens) for k in near[i]) > 1}
    if not markets or any(not markets & set(pair) for pair in ends):
        return None
    balance = np.zeros(len(boxes))
    for (donor, recipient), ribbon in zip(ends, ribbons, strict=True):
        mass = float(peaks[list(ribbon.members)].sum())
        balance[donor] += mass
        balance[recipient] -= mass
    return np.array([1 if i in markets else 0 if mass > 0 else 2 for i, mass in enumerate(balance)], dtype=np.intp)
