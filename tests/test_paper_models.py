"""The published classes, step by step: where the models reproduce them to the last digit, and what float32 does."""

from __future__ import annotations

import numpy as np
import pytest
from paper_classes import PAPER, PaperClass, trajectory

from cirl_marl.compartments import ContinuousModel
from cirl_marl.compartments.incinerator import Incinerator
from cirl_marl.compartments.microalgae_droop import MicroalgaeDroop
from cirl_marl.compartments.microalgae_monod import MicroalgaeMonod
from cirl_marl.compartments.transport_truck import TransportTruck
from cirl_marl.network.rowsum import Floats

CLASSES: dict[str, tuple[ContinuousModel, PaperClass, tuple[int, ...]]] = {
    "TransportTruck": (TransportTruck(form="published"), PAPER["transport_truck"], (0,)),
    "Incinerator": (Incinerator(form="published"), PAPER["incinerator"], (0, 1, 2, 3, 4)),
    "CO2MicroalgaeMonod": (MicroalgaeMonod(form="published"), PAPER["microalgae_monod"], ()),
    "CO2MicroalgaeDroop": (MicroalgaeDroop(form="published"), PAPER["microalgae_droop"], (2,)),
}
"""Model, class, and the states that the published first step rounds to float32."""


def euler(model: ContinuousModel, paper: PaperClass, start: Floats, actions: Floats) -> tuple[Floats, Floats]:
    """Return the states (k, n + 1) and rewards (n,) of the published environment for one action sequence."""
    states, rewards = [start], []
    for action in actions:
        inputs = paper.inputs(np.array([[action]]))
        state = states[-1]
        new = state + paper.dt * model.derivative(state, inputs)
        rewards.append(model.reward(new if model.reward_state == "after" else state, inputs)[0])
        states.append(new)
    return np.concatenate(states, axis=1), np.array(rewards)


class TestReference:
    """The trajectories of the published classes."""

    @pytest.mark.parametrize("name", CLASSES)
    def test_every_row(self, name: str) -> None:
        """From the start that stands for the float32 first step, every later state and every reward to 1e-9."""
        model, paper, _ = CLASSES[name]
        actions, expected, earned = trajectory(name)
        states, rewards = euler(model, paper, np.array(paper.reference_start)[:, None], actions)
        np.testing.assert_allclose(states[:, 1:], expected[1:].T, rtol=1e-9, atol=1e-12)
        # Droop's first reward is K_CO2·ρ at S = 0; the start that stands for it is −1.1e-10
        np.testing.assert_allclose(rewards, earned, rtol=1e-9, atol=4e-9 if name == "CO2MicroalgaeDroop" else 1e-12)

    @pytest.mark.parametrize("name", CLASSES)
    def test_from_the_second_row_to_the_last_digit(self, name: str) -> None:
        """The published step works in float64 from its second step on; there nothing is left to explain."""
        model, paper, _ = CLASSES[name]
        actions, expected, earned = trajectory(name)
        states, rewards = euler(model, paper, expected[1:2].T, actions[1:])
        np.testing.assert_allclose(states, expected[1:].T, rtol=2e-14)
        np.testing.assert_allclose(rewards, earned[1:], rtol=2e-14)

    @pytest.mark.parametrize("name", CLASSES)
    def test_first_step_rounds_to_float32(self, name: str) -> None:
        """NumPy 2 keeps float32 where a float32 state meets Python floats: that is the whole of the first step."""
        model, paper, rounded = CLASSES[name]
        actions, expected, earned = trajectory(name)
        start = np.array(paper.initial_state, dtype=np.float32)[:, None]
        np.testing.assert_array_equal(start[:, 0], expected[0])
        inputs = paper.inputs(actions[:1][None])
        rate = model.derivative(start, inputs)  # type: ignore[arg-type]
        state = start + paper.dt * rate
        for i in rounded:
            state[i] = start[i] + np.float32(paper.dt * rate[i])
        np.testing.assert_allclose(state[:, 0], expected[1], rtol=1e-15)
        after = state if model.reward_state == "after" else start.astype(np.float64)
        np.testing.assert_allclose(model.reward(after, inputs)[0], earned[0], rtol=1e-10)

    @pytest.mark.parametrize("name", CLASSES)
    def test_start_is_the_published_one_in_float32(self, name: str) -> None:
        """The start that stands for the float32 step differs from the published one by less than float32 resolves."""
        _, paper, _ = CLASSES[name]
        np.testing.assert_allclose(paper.reference_start, paper.initial_state, rtol=6e-8, atol=2e-10)
        assert len(paper.inferred_initial) == len(paper.initial_state)

    def test_action_map(self) -> None:
        """−1 and +1 are the bounds, 0 the middle; what lies outside is clipped."""
        actions = np.array([[-2.0, -1.0, 0.0, 1.0, 2.0]])
        inputs = PAPER["microalgae_monod"].inputs(actions)
        np.testing.assert_array_equal(inputs, [[0.0, 0.0, 75.0, 150.0, 150.0]])

    @pytest.mark.parametrize(("action", "total"), [(-1.0, 102.9), (0.0, 101.1), (1.0, 90.4)])
    def test_monod_with_the_reward_of_the_state_before(self, action: float, total: float) -> None:
        """The published class rewards the state after each step; with the state before it the sums were 0.5 lower."""
        model, paper, _ = CLASSES["CO2MicroalgaeMonod"]
        states, _ = euler(model, paper, np.array(paper.initial_state)[:, None], np.full(200, action))
        inputs = paper.inputs(np.full((1, 200), action))
        assert model.reward(states[:, :-1], inputs).sum() == pytest.approx(total, abs=0.05)
