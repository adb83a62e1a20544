"""Rates on accounts that rise with what is charged for: piecewise linear convex costs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated

from cirl_marl.network.declarations import CheckedRecord, NotNegative, Numbers, Scalable, frozen_record
from cirl_marl.network.series import Value


@frozen_record
class PiecewiseRate(CheckedRecord, Scalable):
    """A rate that is higher for what is more than some amounts: q costs r_0·q + Σ_i (r_i − r_{i−1})·max(0, q − to_i).

    The amount q is the mean flow of an interval along an arc or into a node, the mean of the stock at its ends, or the
    distance of a control from its neutral value.
    """

    to: Annotated[
        tuple[float, ...],
        Numbers("amounts up to which all rates but the last hold: mass/time, mass, or in the unit of the control"),
    ]
    rates: Annotated[tuple[float, ...], Numbers("r, each higher than the one before")]
    factor: Annotated[Value, NotNegative("factor on all rates, which may change in time", varies=True)] = 1.0

    @property
    def rises(self) -> tuple[float, ...]:
        """By how much each rate but the first is higher than the one before."""
        return tuple(after - before for before, after in pairwise(self.rates))

    def problems(self) -> Iterator[str]:
        """Yield why they are no convex cost."""
        if not self.to or len(self.rates) != len(self.to) + 1:
            yield f"{len(self.rates)} rates and {len(self.to)} amounts up to which they hold: give one rate more"
            return
        if not all(map(math.isfinite, (*self.to, *self.rates))):
            yield "rates, and the amounts up to which they hold, must be finite"
            return
        for before, after in pairwise((0.0, *self.to)):
            if before >= after:
                yield f"amounts up to which rates hold must be positive and rise, but {after:g} follows {before:g}"
        for before, after in pairwise(self.rates):
            if before >= after:
                fault = f"{after:g} follows {before:g}; what gets cheaper the more there is is not convex"
                yield f"rates must rise, but {fault}, and nothing could be proved"
