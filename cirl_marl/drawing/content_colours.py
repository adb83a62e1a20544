"""Colours of a substance: how much of it stocks and flows hold, on one scale for all that is drawn."""

from __future__ import annotations

from functools import cache
from typing import Annotated

import numpy as np

from cirl_marl.drawing.style import NEUTRAL, number
from cirl_marl.network import Floats
from cirl_marl.network.declarations import positional_record

STOPS = ("#dcd8c3", "#f4d98b", "#f2b04c", "#e6842a", "#cf5a00")
"""Colours from no content to the highest, lighter than ink all along, told apart with any colour vision."""
UNITS = (("%", 0.01, 1e-3), ("ppm", 1e-6, 0.0))
"""Units of contents, with the content from which on each is used."""
USUAL = 0.95
"""Part of all that flows whose contents the scale of colours covers; what has more is as dark as the last of them."""
ABSENT = 1e-12
"""Part of the largest mass below which there is nothing whose content could be told."""


@positional_record
class SubstanceAmounts:
    """How much of a substance is in the stocks and flows of a network."""

    label: Annotated[str, "the substance, in words"]
    stock: Annotated[Floats, "shape (stores,), mass"]
    flow: Annotated[Floats, "shape (arcs,), mass/time"]


class ContentColours:
    """Colours of contents, in [0, 1], on a scale up to the ``highest``; higher ones are as dark."""

    def __init__(self, label: str, contents: Floats, flow: Floats) -> None:
        """Scale the colours of a substance by its contents in flows; both have shape (flows,)."""
        order = np.argsort(contents)  # what there is nothing of comes last
        carried = np.cumsum(np.where(np.isnan(contents), 0.0, np.abs(flow))[order])
        last = int(np.searchsorted(carried, USUAL * carried[-1])) if len(flow) and carried[-1] > 0 else 0
        ordered = contents[order][: last + 1]
        self.highest = min(float(f"{ordered[-1]:.2g}"), 1.0) if len(ordered) and ordered[-1] > 0 else 1.0
        self._is_cut = bool((contents > self.highest * 1.05).any())
        self._label = label

    def of(self, content: float) -> str:
        """Return the colour of a content; NaN, of nothing, is grey."""
        return NEUTRAL if np.isnan(content) else _colour(round(content / self.highest, 3))

    @property
    def steps(self) -> dict[str, str]:
        """What colours at even steps of the scale mean, by colour; the first names the substance."""
        unit, size = next((unit, size) for unit, size, least in UNITS if self.highest >= least)
        shares = np.linspace(0.0, 1.0, len(STOPS)).tolist()
        texts = [f"{number(share * self.highest / size)} {unit}" for share in shares]
        texts[0] = f"{self._label}: {texts[0]}"
        texts[-1] += " or more" if self._is_cut else ""
        return dict(zip(map(_colour, shares), texts, strict=True))


def contents_of(amounts: Floats, whole: Floats) -> Floats:
    """Return amounts as parts of what they are in, NaN where there is nothing; shapes are alike."""
    is_there = np.abs(whole) > ABSENT * np.abs(whole).max(initial=0.0)
    return np.asarray(np.divide(amounts, whole, out=np.full(whole.shape, np.nan), where=is_there))


@cache
def _colour(share: float) -> str:
    """Return the colour at a share of the scale, between its neighbours among ``STOPS``; beyond 1 the last."""
    table = [[int(stop[i : i + 2], 16) for i in (1, 3, 5)] for stop in STOPS]
    places = np.linspace(0.0, 1.0, len(STOPS))
    return "#" + "".join(f"{round(float(np.interp(share, places, row))):02x}" for row in zip(*table, strict=True))
