"""The air between those that emit and those that remove, as one well-mixed box."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from cirl_marl.network.compartment_model import ContinuousModel, RewardState
from cirl_marl.network.declarations import frozen_record
from cirl_marl.network.rowsum import Floats


@frozen_record
class Atmosphere(ContinuousModel):
    """Stock of CO₂ that rises by what is emitted and falls by what is removed: ṁ = ṁ12 − ṁ23 (arXiv 2502.02382).

    It is for studies of the box alone: its agent sets both flows, and no mass of the network moves through it. Where
    emission and removal are arcs, as in ``net_zero``, the node is the box and needs no model: the network integrates
    its stock, and given the same flows both are equal. There is one form. No reward is published; it is −|ṁ12 − ṁ23|,
    zero at net zero.
    """

    kind: ClassVar[str] = "atmosphere"
    state_names: ClassVar[tuple[str, ...]] = ("co2_mmol",)
    input_names: ClassVar[tuple[str, ...]] = ("emission_mmol_day", "removal_mmol_day")
    input_unit: ClassVar[str] = "mmol/day"
    time_unit: ClassVar[str] = "day"
    reward_state: ClassVar[RewardState] = "before"

    def derivative(self, state: Floats, inputs: Floats) -> Floats:
        """Return ṁ, mmol/d, shape (1, B)."""
        return inputs[:1] - inputs[1:2]

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return −|ṁ12 − ṁ23|, mmol/d, shape (B,)."""
        imbalance: Floats = np.abs(inputs[0] - inputs[1])
        return -imbalance
