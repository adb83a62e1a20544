"""Drawing the digraph of a material network, with its stocks and flows, on axes."""

from __future__ import annotations

import math
from collections import Counter
from typing import Annotated, Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import FancyBboxPatch, Patch, Rectangle
from matplotlib.patheffects import withStroke

from cirl_marl.drawing.content_colours import ContentColours, SubstanceAmounts, contents_of
from cirl_marl.drawing.digraph_layout import DigraphLayout, Routes, bezier, digraph_layout
from cirl_marl.drawing.style import FAINT, GOOD, INK, NEUTRAL, ROLE_COLOURS, WARNING, check_shape, number, readable
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import Law, Role

LARGEST_EM = 14.0
"""Largest font of a digraph, points."""
WIDEST = 1.0
"""Width of the arrow that carries the reference flow, em."""
SPARSE = 30
"""Arcs beyond which flows of nothing have no label."""
BROADEST = 1.25
"""Largest width of an arrow, relative to that."""


def draw_network(
    axes: Axes,
    network: Network,
    stock: Floats,
    flow: Floats,
    *,
    title: str = "",
    circularity: float | None = None,
    reference_flow: float | None = None,
    legend: bool = True,
    substance: SubstanceAmounts | None = None,
) -> None:
    """Draw the digraph with its stocks and flows.

    A box is filled to stock / (stock + scale), half at the node's reference stock; one with a dashed edge stores
    nothing, and is filled likewise by what passes through it. The width of an arrow is
    proportional to its flow. Arrows that lower the circularity are vermilion, those that raise it green; those of
    parallel arcs bear their names. With a substance colours show its content instead.
    Networks of more than 60 nodes or 200 arcs are drawn without labels.

    Args:
        axes: where to draw; what they show is cleared.
        network: the network.
        stock: stocks, shape (stores,), mass.
        flow: flows, shape (arcs,), mass/time.
        title: heading.
        circularity: λ, mass, which is written below it; None takes that of ``flow``, and writes none where batches
            move, of which the flows know nothing.
        reference_flow: flow of the widest arrow, mass/time; None: the largest of ``flow``. Pictures with
            the same reference compare.
        legend: whether to explain the colours below the digraph.
        substance: whose contents boxes and arrows are coloured by.

    Raises:
        CirlError: if an array has the wrong shape.
    """
    stock, flow = check_shape("stock", stock, (len(network.stores),)), check_shape("flow", flow, (len(network.arcs),))
    amounts = np.concatenate([stock, network.throughput(flow)])
    reference = largest_flow(flow) if reference_flow is None else reference_flow
    share = np.clip(np.nan_to_num(np.abs(flow)) / max(reference, 1e-12), 0, BROADEST)
    palette = _palette(network, amounts, flow, substance)
    layout = digraph_layout(network, axes.bbox.width / axes.bbox.height)
    axes.clear()
    axes.set_axis_off()
    em = _frame(axes, layout, legend)
    if layout.routes is None:
        _draw_dots(axes, network, layout, amounts, share, em, palette)
    else:
        _draw_arrows(axes, network, layout.routes, flow, share, em, palette.arcs)
        _draw_boxes(axes, network, layout, amounts, em, palette.nodes)
    if circularity is None and all(arc.law is not Law.BATCH for arc in network.arcs):
        with np.errstate(invalid="ignore"):  # flows that overflowed are shown as they are
            circularity = float(network.circularity(flow))
    _write_title(axes, network, circularity, title)
    if legend:
        axes.legend(**legend_of(network, reference, palette), loc="lower center", ncols=4 if substance else 3)


@positional_record
class Palette:
    """The colours of a picture, and what they mean."""

    nodes: Annotated[list[str], "of the boxes"]
    arcs: Annotated[list[str], "of the arrows"]
    meanings: Annotated[dict[str, str], "what each colour says, in the order of the legend"]


def _palette(network: Network, amounts: Floats, flow: Floats, substance: SubstanceAmounts | None) -> Palette:
    """Return the colours of roles and of what flows do to λ, or those of contents."""
    if substance is None:
        nodes, arcs = [ROLE_COLOURS[node.role] for node in network.nodes], _colours(network)
        return Palette(nodes, arcs, _meanings(network))
    stock = check_shape("stock of the substance", substance.stock, (len(network.stores),))
    within = check_shape("flow of the substance", substance.flow, (len(network.arcs),))
    of_nodes = contents_of(np.concatenate([stock, network.throughput(within)]), amounts)
    of_arcs = contents_of(within, flow)
    colours = ContentColours(substance.label, of_arcs, flow)
    return Palette([*map(colours.of, of_nodes)], [*map(colours.of, of_arcs)], colours.steps | {NEUTRAL: "nothing"})


def largest_flow(flow: Floats) -> float:
    """Return the largest finite |f|, mass/time; 0 if there is none."""
    return float(np.abs(flow, where=np.isfinite(flow), out=np.zeros(flow.shape)).max(initial=0.0))


def _meanings(network: Network) -> dict[str, str]:
    """Return what the colours of roles and of effects on λ mean."""
    roles = dict.fromkeys(node.role for node in sorted(network.nodes, key=lambda n: list(Role).index(n.role)))
    patches: dict[str, str] = {}
    for role in roles:
        colour, name = ROLE_COLOURS[role], readable(role).replace("nonrenewable", "non-renewable")
        patches[colour] = f"{patches[colour]}, {name}" if colour in patches else name
    sign = network.sustainability
    arrows = {WARNING: "flow that lowers λ", GOOD: "flow that raises λ", NEUTRAL: "other flow"}
    present = {WARNING: (sign > 0).any(), GOOD: (sign < 0).any(), NEUTRAL: (sign == 0).any()}
    return patches | {colour: label for colour, label in arrows.items() if present[colour]}


def legend_of(network: Network, reference: float, palette: Palette | None = None) -> dict[str, Any]:
    """Return handles and look of the legend that explains colours, fill and width, that of the flow ``reference``."""
    patches = _meanings(network) if palette is None else palette.meanings
    handles: list[Artist] = [Patch(facecolor=colour, label=label) for colour, label in patches.items()]
    width = f"widest arrow: {number(reference)} {network.mass_unit}/{network.time_unit}"
    handles.append(Line2D([], [], color=NEUTRAL, linewidth=4, label=width))
    handles.append(Patch(facecolor="none", edgecolor=FAINT, label="half full: the reference stock or flow"))
    return {"handles": handles, "frameon": False, "fontsize": 8, "labelcolor": FAINT, "handlelength": 1.2}


def _frame(axes: Axes, layout: DigraphLayout, legend: bool) -> float:
    """Set limits in em around the digraph and return the size of one em in points."""
    low, high = layout.extent()
    width, height = (72 * pixels / axes.figure.dpi for pixels in axes.bbox.size)
    strip = 42.0 if legend else 4.0
    em = min(width / (high[0] - low[0] + 1), (height - strip) / (high[1] - low[1] + 1))
    em = float(min(em, LARGEST_EM) if layout.routes is not None else em)
    middle = (low + high) / 2
    axes.set_xlim(middle[0] - width / em / 2, middle[0] + width / em / 2)
    bottom = middle[1] - (height + strip) / em / 2
    axes.set_ylim(bottom, bottom + height / em)
    return em


def _colours(network: Network) -> list[str]:
    return [WARNING if sign > 0 else GOOD if sign < 0 else NEUTRAL for sign in network.sustainability]


def _draw_arrows(
    axes: Axes, network: Network, routes: Routes, flow: Floats, share: Floats, em: float, colours: list[str]
) -> None:
    signs = _colours(network)
    along = zip(routes.curves, flow, share, strict=True)
    shapes = [_arrow(curve if value >= 0 else curve[::-1], WIDEST * size) for curve, value, size in along]
    arrows = PolyCollection(shapes, facecolors=colours, edgecolors="white", linewidths=0.4, zorder=2)
    axes.add_collection(arrows, autolim=False)
    halo = [withStroke(linewidth=0.25 * em, foreground="white")]
    ends = Counter((arc.donor, arc.recipient) for arc in network.arcs)
    for arc, (x, y), value, colour in zip(network.arcs, routes.labels, flow, signs, strict=True):
        ink = FAINT if colour is NEUTRAL or colours != signs else colour
        if value == 0 and len(network.arcs) > SPARSE:
            continue  # so many labels of nothing would hide the others
        parallel = ends[arc.donor, arc.recipient] > 1
        label = f"{arc.label}\n{number(value)}" if parallel else number(value)
        axes.text(x, y, label, color=ink, fontsize=(0.8 if parallel else 0.95) * em, ha="center", va="center",
                  zorder=5, path_effects=halo)  # fmt: skip


def _arrow(curve: Floats, width: float) -> Floats:
    """Return the outline of an arrow along ``curve``, shape (points, 2); it never gets too thin to see."""
    width = max(width, 0.09)
    head, flare = 0.55 + 0.55 * width, 0.3 + 0.75 * width
    length = np.hypot(*np.diff(curve, axis=0).T)
    to_tip = np.concatenate([np.cumsum(length[::-1])[::-1], [0.0]])
    shaft = curve[to_tip >= min(head, 0.6 * to_tip[0])]
    along = np.gradient(shaft, axis=0) if len(shaft) > 1 else curve[-1:] - curve[:1]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    tip, neck, across = curve[-1], shaft[-1], normal[-1]
    sides = shaft + normal * width / 2, shaft - normal * width / 2
    return np.concatenate([sides[0], [neck + across * flare, tip, neck - across * flare], sides[1][::-1]])


def _draw_boxes(
    axes: Axes, network: Network, layout: DigraphLayout, amounts: Floats, em: float, colours: list[str]
) -> None:
    width, height = layout.box
    units = {True: network.mass_unit, False: f"{network.mass_unit}/{network.time_unit}"}
    places = zip(network.nodes, layout.positions, amounts, layout.names, colours, strict=True)
    for node, (x, y), amount, name, colour in places:
        corner = (x - width / 2, y - height / 2)
        look = "round,pad=0,rounding_size=0.5"
        axes.add_patch(FancyBboxPatch(corner, width, height, look, fc=_tint(colour, 0.25), ec="none", zorder=3))
        level = Rectangle(corner, width, height * _fill(amount, node.scale), fc=colour, ec="none", zorder=3.1)
        line_style = "solid" if node.stores else "dashed"
        edge = FancyBboxPatch(
            corner, width, height, look, fc="none", ec=_darker(colour), lw=0.1 * em, ls=line_style, zorder=3.2
        )
        axes.add_patch(level)
        axes.add_patch(edge)
        level.set_clip_path(edge)
        top = y + 0.6 * len(name)
        for line, text in enumerate((*name, f"{number(amount)} {units[node.stores]}")):
            bold = "bold" if line < len(name) else "normal"
            axes.text(x, top - 1.2 * line, text, color=INK, fontsize=0.95 * em, fontweight=bold, ha="center",
                      va="center", zorder=4)  # fmt: skip


def _fill(amount: float, scale: float) -> float:
    """Share of a box that a stock fills: 0 without stock or for one that is no number, half at ``scale``."""
    positive = max(amount, 0.0) if math.isfinite(amount) else 0.0
    return positive / (positive + scale)


def _tint(colour: str, share: float) -> str:
    """Mix a colour with white."""
    return "#" + "".join(f"{round(255 - share * (255 - int(colour[i : i + 2], 16))):02x}" for i in (1, 3, 5))


def _darker(colour: str) -> str:
    return "#" + "".join(f"{int(colour[i : i + 2], 16) * 6 // 10:02x}" for i in (1, 3, 5))


def _draw_dots(
    axes: Axes,
    network: Network,
    layout: DigraphLayout,
    amounts: Floats,
    share: Floats,
    em: float,
    palette: Palette,
) -> None:
    """Draw a large network: dots whose area shows the stock or throughput, bent lines whose width shows the flow."""
    ends = layout.positions[network.donors], layout.positions[network.recipients]
    # Arcs that count towards λ come last, on top of the others.
    colours, order = palette.arcs, np.argsort(np.abs(network.sustainability), kind="stable")
    lines = bezier(*ends, np.full(len(network.arcs), 0.12), 12)
    thickest = min(2.5, 40 / math.sqrt(len(network.arcs)))
    inks, widths = [colours[k] for k in order], np.clip(thickest * share[order], 0.15, None)
    axes.add_collection(LineCollection(list(lines[order]), colors=inks, linewidths=widths, alpha=0.6), autolim=False)
    fill = np.array([_fill(amount, node.scale) for amount, node in zip(amounts, network.nodes, strict=True)])
    area = (0.6 * em * layout.box[1]) ** 2 * (0.15 + 0.85 * fill)
    faces = palette.nodes
    edges = [_darker(face) for face in faces]
    x, y = layout.positions.T
    axes.scatter(x, y, s=np.maximum(area, 4.0), c=faces, edgecolors=edges, linewidths=0.4, zorder=3)


def _write_title(axes: Axes, network: Network, circularity: float | None, title: str) -> None:
    heading = title or network.title or readable(network.name)
    below = "" if circularity is None else f"λ = {number(circularity)} {network.mass_unit}    "
    below += f"flows in {network.mass_unit}/{network.time_unit}"
    axes.text(0.5, 1.075, heading, transform=axes.transAxes, fontsize=11, fontweight="bold", color=INK, ha="center")
    axes.text(0.5, 1.02, below, transform=axes.transAxes, fontsize=9.5, color=FAINT, ha="center")
