"""Kinds of parameters of models, for the annotations of their fields; see ``network.declared``."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Literal

from cirl_marl.network.declared import Quantity, Word

Positive = partial(Quantity, positive=True)
NotNegative = partial(Quantity, low=0.0)
Share = partial(Quantity, low=0.0, high=1.0)
Form = Annotated[Literal["published", "sound"], Word("``published`` or ``sound``", of=("published", "sound"))]
