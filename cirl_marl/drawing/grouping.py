"""Large networks folded by group: the whole as groups and what runs between them, and the inside of each."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from cirl_marl.drawing.flow_diagram import Box, FlowDiagram, Ribbon, arrange_boxes, flow_diagram
from cirl_marl.drawing.style import readable
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.elements import Role

FOLDED_NODES = 60
"""Networks with more nodes open folded, if their titles tell groups."""
LEAST_GROUPS, LEAST_MEMBERS = 3, 4
MARK = ": "
"""What stands between the group and the rest of a title, as in ``Japan: Scrap``."""


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
    """Return the diagrams of a network whose arcs carry at most ``peaks``: one, or one of groups and each inside."""
    group_nodes = groups(network)
    if not group_nodes:
        return [flow_diagram(network, peaks)]
    return [
        _diagram_of_groups(network, group_nodes, "", peaks),
        *(_diagram_of_groups(network, group_nodes, name, peaks) for name in group_nodes),
    ]


def _diagram_of_groups(
    network: Network, group_nodes: Mapping[str, list[int]], open_group: str, peaks: Floats
) -> FlowDiagram:
    """Return the diagram with one group unfolded, and of the rest only what it has to do with."""
    inside = set(group_nodes.get(open_group, ()))
    group = {i: name for name, members in group_nodes.items() if name != open_group for i in members}
    ends = list(zip(network.donors.tolist(), network.recipients.tolist(), strict=True))
    if open_group:
        near = {i for pair in ends if inside & set(pair) for i in pair}
        near |= {i for name in {group[i] for i in near if i in group} for i in group_nodes[name]}
    else:
        near = set(range(len(network.nodes)))
    boxes: list[Box] = []
    box_of: dict[int, int] = {}
    for i, node in enumerate(network.nodes):
        if i not in near or i in box_of:
            continue
        if (name := group.get(i, "")) == "":
            box_of[i] = len(boxes)
            label = node.label.removeprefix(f"{open_group}{MARK}")
            boxes.append(Box(label, (i,), node.role, node.stores))
        else:
            box_of |= dict.fromkeys(group_nodes[name], len(boxes))
            stores = tuple(k for k in group_nodes[name] if network.nodes[k].stores)
            boxes.append(Box(name, stores, Role.TECHNOSPHERE, bool(stores), opens=name))
    between: dict[tuple[int, int], list[int]] = defaultdict(list)
    for k, (donor, recipient) in enumerate(ends):
        if donor not in box_of or recipient not in box_of or (open_group and not inside & {donor, recipient}):
            continue
        if (pair := (box_of[donor], box_of[recipient])) and pair[0] != pair[1]:
            between[pair].append(k)
    ribbons = [Ribbon(tuple(members), *pair) for pair, members in between.items()]
    return arrange_boxes(
        open_group, boxes, ribbons, peaks, None if open_group else _around_markets(boxes, ribbons, peaks)
    )


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
