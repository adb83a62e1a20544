"""Actions to controls and back: rounding leads out of no bound, and nobody has to act."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RescaleAction
from hypothesis import assume, given
from hypothesis import strategies as st

from cirl_marl import Arc, CirlError, Control, ControlError, ControlKind, MultiAgentVectorEnv, Network, Node
from cirl_marl.controllers import Neutral, Random
from cirl_marl.controllers.rollout import rollout
from cirl_marl.evaluation import compare

hundredths = st.integers(0, 300).map(lambda n: n / 100)


def valve(low: float, neutral: float, high: float) -> Network:
    """Return a network of one valve."""
    control = Control(kind=ControlKind.RATE, low=low, neutral=neutral, high=high)
    return Network(
        name="valve",
        nodes=(Node(id="a", initial=(9.0, 9.0)), Node(id="b")),
        arcs=(Arc(id="k", donor="a", recipient="b", rate=0.1, control=control),),
    )


@given(hundredths, hundredths, st.sampled_from(["low", "high"]))
def test_neutral_at_a_bound_is_an_action(low: float, high: float, where: str) -> None:
    """Decimal bounds round; the neutral action is still one that ``step`` takes, and the ends are the bounds."""
    assume(low < high)
    env = MultiAgentVectorEnv(valve(low, low if where == "low" else high, high), num_envs=2)
    action = env.neutral_action["k"]
    assert action == pytest.approx(-1.0 if where == "low" else 1.0)
    assert (abs(action) <= 1.0).all()
    assert np.isfinite(rollout(env, Neutral(), seed=0).circularity).all()
    first = np.zeros(2, dtype=np.intp)
    rates = [env.dynamics.rate(env.actuators.controls(np.full((1, 2), end), first))[0, 0] for end in (-1.0, 1.0)]
    assert 0.1 * low <= rates[0] == pytest.approx(0.1 * low)
    assert 0.1 * high >= rates[1] == pytest.approx(0.1 * high)


@given(st.floats(-9.0, 0.0), st.floats(1.0, 9.0))
def test_rescaled_actions_are_taken(low: float, high: float) -> None:
    """Gymnasium's wrapper works in single precision and may land a rounding beyond the bounds."""
    env = RescaleAction(gymnasium.make("cirl_marl/CarboNet-v0"), np.float32(low), np.float32(high))
    env.reset(seed=0)
    for action in (env.action_space.low, env.action_space.high):  # type: ignore[attr-defined]
        env.step(action)
    with pytest.raises(ControlError, match="must be a number in"):
        env.unwrapped.step(np.array([1.00001]))


def test_nobody_has_to_act() -> None:
    """A network without controls is simulated, drawn at random, paid and compared; one with controls wants agents."""
    network = valve(0.0, 1.0, 2.0)
    still = replace(network, arcs=(replace(network.arcs[0], control=None),))
    for reward in ("local", "difference", "mixed_difference", "team"):
        env = MultiAgentVectorEnv(still, num_envs=2, reward=reward)
        for controller in (Random(), Neutral()):
            assert np.isfinite(rollout(env, controller, seed=0).circularity).all()
    assert [row.name for row in compare([], ["random"], network=still, episodes=2).rows] == ["neutral", "random"]
    with pytest.raises(CirlError, match=r"agents \[\] must be distinct and at least one"):
        MultiAgentVectorEnv(network, num_envs=1, agents=[])
