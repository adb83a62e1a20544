"""Pictures of a material network: as a file, two side by side, or frame by frame in a window."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cirl_marl.drawing.content_colours import SubstanceAmounts
from cirl_marl.drawing.folding import fold_copies
from cirl_marl.drawing.picture import draw_network, largest_flow, legend_of
from cirl_marl.drawing.style import number, readable, save
from cirl_marl.errors import optional_module
from cirl_marl.network import Floats, Network
from cirl_marl.network.calendar import labels

__all__ = ["Canvas", "draw_network", "save_before_after", "save_network"]

FRAME_INCHES = (9.0, 6.2)
FRAME_DPI = 100


class Window:
    """A pygame window of fixed size; it opens with the first picture."""

    def __init__(self, caption: str) -> None:
        """Check that pygame is there; a ``CirlError`` if not."""
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # pygame greets on stdout otherwise
        self._pygame = optional_module("pygame", "render_mode 'human' needs pygame", "human")
        self._caption = caption
        self._screen: Any = None

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show an image, shape (height, width, 3)."""
        if self._screen is None:
            self._pygame.display.init()
            self._screen = self._pygame.display.set_mode((image.shape[1], image.shape[0]))
            self._pygame.display.set_caption(self._caption)
        self._pygame.event.pump()
        self._pygame.surfarray.blit_array(self._screen, image.swapaxes(0, 1))
        self._pygame.display.flip()

    def close(self) -> None:
        """Close the window; it opens again with the next picture."""
        if self._screen is not None:
            self._pygame.display.quit()
            self._screen = None


class Canvas:
    """Draws one network again and again, for ``render()``; the picture depends on what is drawn alone.

    Arrows are as wide as their flow relative to the largest reference flow of the network, or to the largest
    flow of the frame if that is larger still.
    """

    def __init__(self, network: Network, *, window: bool) -> None:
        """Prepare pictures of ``network``; a ``CirlError`` if a window is wanted and pygame is not installed."""
        self._network = network
        self._window = Window(readable(network.name)) if window else None
        self._reference = max((arc.scale for arc in network.arcs), default=0.0)
        self._figure = Figure(figsize=FRAME_INCHES, dpi=FRAME_DPI, facecolor="white")
        self._agg = FigureCanvasAgg(self._figure)
        self._axes = self._figure.add_axes((0.01, 0.01, 0.98, 0.87))

    def draw(self, stock: Floats, flow: Floats, time: float, circularity: float | None = None) -> NDArray[np.uint8]:
        """Return the picture, shape (height, width, 3), and show it if there is a window.

        ``time`` is that of the stocks, for the heading; for the others see ``draw_network``.
        """
        network, stock, flow = fold_copies(self._network, stock, flow)
        reference = max(self._reference, largest_flow(flow))
        calendar, dates = labels(network, time)
        moment = [*calendar, *dates[0]] if dates else [network.time_unit, number(time)]
        title = f"{readable(network.name)}, {' '.join(moment)}"
        draw_network(self._axes, network, stock, flow, title=title, circularity=circularity, reference_flow=reference)
        self._agg.draw()  # type: ignore[no-untyped-call]
        pixels = np.asarray(self._agg.buffer_rgba())  # type: ignore[no-untyped-call]
        image: NDArray[np.uint8] = pixels[..., :3].copy()
        if self._window is not None:
            self._window.show(image)
        return image

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()


def save_network(
    path: str | Path,
    network: Network,
    stock: Floats,
    flow: Floats,
    title: str = "",
    circularity: float | None = None,
    open_copies: Collection[str] = (),
    substance: SubstanceAmounts | None = None,
) -> Path:
    """Save the digraph with its stocks and flows as a PNG, 1800 pixels wide, and return its path.

    Its folder is made; without a title it has that of the network. Copies are folded, but for ``open_copies``. For the
    other arguments see ``draw_network``.
    """
    if substance is not None:
        stock, flow = np.stack([stock, substance.stock], axis=1), np.stack([flow, substance.flow], axis=1)
    network, stock, flow = fold_copies(network, stock, flow, open_copies)
    if substance is not None:
        substance = replace(substance, stock=stock[:, 1], flow=flow[:, 1])
        stock, flow = stock[:, 0], flow[:, 0]
    figure = Figure(figsize=FRAME_INCHES)
    axes = figure.add_axes((0.01, 0.01, 0.98, 0.87))
    draw_network(axes, network, stock, flow, title=title, circularity=circularity, substance=substance)
    return save(figure, path)


def save_before_after(
    path: str | Path,
    network: Network,
    before: tuple[Floats, Floats],
    after: tuple[Floats, Floats],
    labels: tuple[str, str] = ("before", "after"),
    circularity: tuple[float | None, float | None] = (None, None),
) -> Path:
    """Save two states of one network side by side, with arrows at the same scale, and return the path.

    Args:
        path: file to write; its folder is made.
        network: the network.
        before: stocks, shape (stores,), and flows, shape (arcs,).
        after: the same, later or under other control.
        labels: headings of the two.
        circularity: λ of the two, mass; see ``draw_network``.
    """
    figure = Figure(figsize=(9.0, 5.6))
    reference = max(largest_flow(np.asarray(flow)) for _, flow in (before, after))
    for column, ((stock, flow), label, value) in enumerate(zip((before, after), labels, circularity, strict=True)):
        axes = figure.add_axes((0.005 + 0.5 * column, 0.1, 0.49, 0.78))
        drawing, stock, flow = fold_copies(network, stock, flow)
        draw_network(axes, drawing, stock, flow, title=label, circularity=value, reference_flow=reference, legend=False)
    figure.legend(**legend_of(network, reference), loc="lower center", ncols=3)
    return save(figure, path)
