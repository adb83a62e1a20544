"""Models whose time has another unit than that of their network: both ways in which a model moves heed it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

from cirl_marl import Arc, Episode, Law, MultiAgentVectorEnv, Network, Node
from cirl_marl.compartments import ContinuousModel, OutflowModel, OwnStepModel, RewardState
from cirl_marl.network import Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class _Decay(OutflowModel):
    """ż = −k z, k = 0.1/h; z is given off."""

    kind: ClassVar[str] = "decay"
    state_names: ClassVar[tuple[str, ...]] = ("rest",)
    input_names: ClassVar[tuple[str, ...]] = ()
    time_unit: ClassVar[str] = "h"
    reward_state: ClassVar[RewardState] = "after"

    def outflow(self, state: Floats, inputs: Floats) -> Floats:
        """Return z."""
        rest: Floats = state[0]
        return rest

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return nothing."""
        return np.zeros(state.shape[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Continuous(_Decay, ContinuousModel):
    """Its derivative is integrated."""

    def derivative(self, state: Floats, inputs: Floats, *_: Any, **context: Any) -> Floats:
        """Return −k z, per hour."""
        return -0.1 * state


@dataclass(frozen=True, slots=True, kw_only=True)
class _OwnStep(_Decay, OwnStepModel):
    """It moves by itself."""

    def integrate(
        self, state: Floats, inputs: Floats, interval: float, *_: Any, **context: Any
    ) -> tuple[Floats, Floats]:
        """Return z e^{−kt} and its mean over t hours."""
        turned_over = 0.1 * interval
        return state * math.exp(-turned_over), -state[0] * math.expm1(-turned_over) / turned_over


@pytest.mark.parametrize("model", [_Continuous(), _OwnStep()])
def test_a_model_in_hours_decays_in_a_network_of_days(model: _Continuous | _OwnStep) -> None:
    """After a quarter of a day z = z_0 e^{−0.6}; what it gave off is the mean of z, in the network's time."""
    network = Network(
        name="clock",
        nodes=(Node(id="plant", initial=(90.0, 90.0), model=model, inner=((5.0, 5.0),)), Node(id="air")),
        arcs=(Arc(id="gas", donor="plant", recipient="air", law=Law.COMPARTMENT, by="plant", rate=2.0),),
        episode=Episode(control_interval=0.25, horizon=2, solver="rk4", solver_step=0.0125),
        time_unit="day",
    )
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    outcome = env.advance(np.zeros((0, 1)))
    assert env.physical.inner[0, 0] == pytest.approx(5.0 * math.exp(-0.6), rel=1e-7)
    mean = -5.0 * math.expm1(-0.6) / 0.6
    assert outcome.flow[0, 0] == pytest.approx(2.0 * mean, rel=1e-7)
    assert env.physical.stock[1, 0] == pytest.approx(2.0 * mean * 0.25, rel=1e-7)
