"""Gains of the linear-quadratic regulator on random systems: optimality, modes out of reach, what cannot be held."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.linalg import solve_continuous_lyapunov

from cirl_marl import CirlError
from cirl_marl.controllers.lqr import full_state_gain, output_gain
from cirl_marl.network import Floats


@st.composite
def systems(draw: st.DrawFn) -> tuple[Floats, Floats, Floats, Floats]:
    """Draw A (stable), B, Q and R of a controllable system."""
    n, m = draw(st.integers(1, 6)), draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    A = rng.normal(size=(n, n))
    A -= (np.linalg.eigvals(A).real.max() + rng.uniform(0.05, 1.0)) * np.eye(n)
    B, half, input_half = rng.normal(size=(n, m)), rng.normal(size=(n, n)), rng.normal(size=(m, m))
    return A, B, half @ half.T, input_half @ input_half.T + 0.1 * np.eye(m)


@given(systems(), st.integers(0, 2**32 - 1))
def test_gain_is_optimal(system: tuple[Floats, Floats, Floats, Floats], seed: int) -> None:
    """The Riccati residual vanishes, the loop is stable, and no gain near by costs less from any start."""
    A, B, Q, R = system
    K, P = full_state_gain(A, B, Q, R)
    residual = A.T @ P + P @ A - P @ B @ np.linalg.solve(R, B.T @ P) + Q
    assert np.abs(residual).max() < 1e-8 * np.abs(Q).max()
    assert np.linalg.eigvals(A - B @ K).real.max() < 0.0
    other = K + 0.1 * np.random.default_rng(seed).normal(size=K.shape)
    closed = A - B @ other
    assume(np.linalg.eigvals(closed).real.max() < -1e-3)
    cost = solve_continuous_lyapunov(closed.T, -Q - other.T @ R @ other)
    extra = np.linalg.eigvalsh(cost - P)
    assert extra.min() > -1e-8 * np.abs(cost).max()
    assert extra.max() > 1e-8 * np.abs(cost).max()


@given(systems(), systems())
def test_modes_out_of_reach(
    system: tuple[Floats, Floats, Floats, Floats], other: tuple[Floats, Floats, Floats, Floats]
) -> None:
    """Stable modes that control does not reach are allowed for: the Riccati equation holds for the whole system."""
    (A, B, Q, R), (beyond, _, weight, _) = system, other
    n, k = len(A), len(beyond)
    whole, inputs, weights = np.zeros((n + k, n + k)), np.zeros((n + k, B.shape[1])), np.zeros((n + k, n + k))
    whole[:n, :n], whole[n:, n:], whole[:n, n:] = A, beyond, 0.5
    inputs[:n] = B
    weights[:n, :n], weights[n:, n:] = Q, weight
    K, P = full_state_gain(whole, inputs, weights, R)
    residual = whole.T @ P + P @ whole - P @ inputs @ np.linalg.solve(R, inputs.T @ P) + weights
    assert np.abs(residual).max() < 1e-8 * max(1.0, np.abs(P).max())
    np.testing.assert_allclose(K[:, :n], full_state_gain(A, B, Q, R)[0], rtol=1e-7, atol=1e-9)


@given(systems())
def test_output_feedback_of_all_states_is_the_regulator(system: tuple[Floats, Floats, Floats, Floats]) -> None:
    """With C = I the fixed point is the full-state gain."""
    A, B, Q, R = system
    np.testing.assert_allclose(
        output_gain(A, B, np.eye(len(A)), Q, R)[0], full_state_gain(A, B, Q, R)[0], rtol=1e-7, atol=1e-9
    )


def test_mode_that_cannot_be_stabilised() -> None:
    """An uncontrollable integrator or growth is refused with its eigenvalue; the same mode in reach is stabilised."""
    weights = np.eye(2), np.eye(1)
    for mode in (0.0, 0.25):
        A = np.array([[-1.0, 0.3], [0.0, mode]])
        with pytest.raises(CirlError, match=rf"no control reaches the mode with eigenvalue {mode:g}\b"):
            full_state_gain(A, np.array([[1.0], [0.0]]), *weights)
        K, _ = full_state_gain(A, np.array([[0.0], [1.0]]), *weights)
        assert np.linalg.eigvals(A - np.array([[0.0], [1.0]]) @ K).real.max() < 0.0
