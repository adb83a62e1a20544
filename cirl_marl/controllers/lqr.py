"""Linear-quadratic regulator for networks whose acting compartments set flows.

With u the flows that the acting agents set and every other control neutral, the laws read ẋ = A x + B u + c. The
papers' regulator feeds back the distance to an equilibrium that suits the set-points: u = u_e − K (x − x_e), or, if
only outputs y = C x are measured, u = u_e − K (y − y_e).

References: Zocco et al., arXiv 2508.16774 (CarboNet); Kučera and de Souza 1995, Automatica 31(9) (output feedback).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from cirl_marl.controllers.basic import Arrays, Controller
from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.environments.actuators import Actuators
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, ControlError, check_names
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import frozen_record
from cirl_marl.network.elements import ControlKind, Law, Role

RANK, DECAY = 1e-9, 1e-7
"""Relative singular value, and rate of decay relative to ‖A‖, below which they count as zero."""
ITERATIONS, TOLERANCE = 500, 1e-12
"""Most steps of the fixed point of output feedback, and the relative change at which it has converged."""


@frozen_record
class LinearSystem:
    """The linear laws ẋ = A x + B u + c of a network, read off its compiled flow laws.

    States are the stocks that drive a flow or have a set-point; the others only count what passes. A non-renewable
    reservoir without a set-point is held at the middle of its initial range. The laws hold while no donor runs dry.
    """

    states: Annotated[tuple[str, ...], "nodes, in network order"]
    inputs: Annotated[tuple[str, ...], "acting agents"]
    A: Annotated[Floats, "shape (states, states), 1/time"]
    B: Annotated[Floats, "shape (states, inputs), dimensionless"]
    c: Annotated[Floats, "shape (states,), mass/time"]
    set_points: Annotated[Floats, "of the states, NaN where there is none, mass"]
    scale: Annotated[Floats, "reference values of the states, then of the inputs, mass and mass/time"]
    bounds: Annotated[Floats, "lower and upper bounds of the inputs, shape (2, inputs), mass/time"]
    neutral: Annotated[Floats, "their values while nobody acts, shape (inputs,), mass/time"]

    @classmethod
    def of(
        cls, network: Network, agents: Sequence[str] | None = None, set_points: Mapping[str, float] | None = None
    ) -> LinearSystem:
        """Read the system off the flows of unit stocks and unit controls; arguments are as in ``LQR``.

        Raises:
            CirlError: if an agent or node is unknown, no state can be moved, or the laws are not linear in x and u.
        """
        laws = FlowLaws(network)
        actuators = Actuators(network, agents, 1)
        inputs, action_rows = actuators.agents, actuators.control_rows
        if problems := list(_nonlinear(network, inputs)):
            problem = f"is no linear system: {'; '.join(problems)}. {_remedy(network)}"
            raise CirlError(f"'{network.name}' ({network.scenario_name}) {problem}")
        controls = np.repeat(laws.neutral[:, :1], 1 + len(action_rows), axis=1)
        controls[action_rows] = np.eye(1 + len(action_rows))[1:]
        rate, units = laws.rate(controls), np.eye(laws.rows.masses)  # no input, then one unit of each
        routes = laws.routing.routes(rate[:, :1])

        def gain(masses: Floats, rate: Floats) -> Floats:
            flow = laws.flow(masses, rate)
            if routes is not None:
                laws.routing.pass_on(flow, routes)
            return laws.incidence(flow)[:-1]

        A, c = np.split(gain(units, np.repeat(rate[:, :1], len(units), axis=1)), [-1], axis=1)
        B = gain(units[:, [-1] * len(action_rows)], rate[:, 1:] - rate[:, :1])
        targets = _targets(network, set_points)
        has_target = np.array([node.id in targets for node in network.stores], dtype=bool)
        is_constant = (
            np.array([node.role is Role.NONRENEWABLE_RESERVOIR for node in network.stores], dtype=bool) & ~has_target
        )
        c = c[:, 0] + A[:, is_constant] @ network.initial.mean(axis=0)[is_constant]
        rows = np.flatnonzero((A.any(axis=0) | has_target) & ~is_constant)
        if not B[rows].any():
            raise CirlError(f"network '{network.name}': {list(inputs)} move no stock that drives a flow or is tracked")
        nodes = [network.nodes[i] for i in rows]
        flows = [next(a for a in network.arcs if a.law is Law.CONTROLLED and id_ in (a.id, a.donor)) for id_ in inputs]
        return cls(
            states=tuple(node.id for node in nodes),
            inputs=inputs,
            A=A[np.ix_(rows, rows)],
            B=B[rows],
            c=c[rows],
            set_points=np.array([targets.get(node.id, np.nan) for node in nodes]),
            scale=np.array([element.scale for element in (*nodes, *flows)]),
            bounds=np.stack([laws.control_low[action_rows, 0], laws.control_high[action_rows, 0]]),
            neutral=laws.neutral[action_rows, 0],
        )

    def equilibrium(self) -> tuple[Floats, Floats]:
        """Return x_e, shape (states,), and u_e, shape (inputs,), the equilibrium nearest to the set-points.

        Of all with A x_e + B u_e + c = 0 it has the smallest Σ((x_e − set-point)/scale)²; where that leaves a choice,
        inputs nearest to neutral.

        Raises:
            CirlError: if there is no equilibrium, it is not unique, a stock is negative or an input out of bounds.
        """
        count = len(self.states)
        laws = np.hstack([self.A, self.B]) * self.scale
        equilibrium = linalg.lstsq(laws, -self.c, cond=RANK)[0]
        if np.abs(laws @ equilibrium + self.c).max() > RANK * np.abs(self.c).max():
            raise CirlError(f"LQR: no equilibrium: whatever constant {list(self.inputs)}, some stock drifts for ever")
        target = np.append(self.set_points, self.neutral) / self.scale
        free = linalg.null_space(laws, rcond=RANK)
        for rows in np.flatnonzero(~np.isnan(self.set_points)), np.arange(count, len(target)):
            U, sizes, right = linalg.svd(free[rows])
            rank = int((sizes > RANK).sum())
            equilibrium = equilibrium + free @ (
                right[:rank].T @ ((U.T @ (target - equilibrium)[rows])[:rank] / sizes[:rank])
            )
            free = free @ right[rank:].T
        if free.size:
            loose = self.states[int(np.abs(free[:count]).max(axis=1).argmax())]
            raise CirlError(f"LQR: the set-points leave '{loose}' free at equilibrium: give it one in set_points")
        equilibrium *= self.scale
        low, high = np.hstack([[np.zeros(count), np.full(count, np.inf)], self.bounds])
        if (out := (equilibrium < low - RANK * self.scale) | (equilibrium > high + RANK * self.scale)).any():
            name, value = (*self.states, *self.inputs)[out.argmax()], equilibrium[out.argmax()]
            raise CirlError(f"LQR: the set-points want an equilibrium out of bounds, '{name}' = {value:.6g}")
        return equilibrium[:count], equilibrium[count:]


def full_state_gain(A: Floats, B: Floats, Q: Floats, R: Floats) -> tuple[Floats, Floats]:
    """Return K, shape (m, n), of u = −K x, which minimises ∫ xᵀQx + uᵀRu dt under ẋ = A x + B u, and P, shape (n, n).

    A and Q have shape (n, n), B (n, m), R (m, m); Q is positive semi-definite, R positive definite. K = R⁻¹BᵀP, where P
    is the stabilising solution of AᵀP + PA − PBR⁻¹BᵀP + Q = 0, and xᵀPx is the cost from x. The equation is solved on
    what control reaches; what that feeds back of the rest, one Newton step (Kleinman) gives exactly.

    Raises:
        CirlError: if a mode that control does not reach is not stable, or the weights leave no stabilising optimum.
    """
    reachable, rest = _kalman(A, B)
    _refuse_unstable(rest.T @ A @ rest, A, "no control reaches")
    try:
        core = linalg.solve_continuous_are(reachable.T @ A @ reachable, reachable.T @ B, reachable.T @ Q @ reachable, R)
    except linalg.LinAlgError as error:
        raise CirlError(f"LQR: no optimal gain stabilises; does a mode cost nothing? ({error})") from error
    K = linalg.solve(R, B.T @ reachable @ core @ reachable.T)
    _refuse_unstable(A - B @ K, A, "the weights ignore")
    for _ in range(2):  # the Newton step, then P of the gain it gave
        P = linalg.solve_continuous_lyapunov((A - B @ K).T, -Q - K.T @ R @ K)
        K = linalg.solve(R, B.T @ P)
    return K, P


def output_gain(A: Floats, B: Floats, C: Floats, Q: Floats, R: Floats) -> tuple[Floats, Floats]:
    """Return K, shape (m, p), of the papers' static output feedback u = −K y, y = C x, and P, shape (n, n).

    C has shape (p, n) and rank p, the others are as in ``full_state_gain``. The fixed point of
    K ← R⁻¹BᵀP(K)Cᵀ(CCᵀ)⁻¹, where (A − BKC)ᵀP + P(A − BKC) + Q + CᵀKᵀRKC = 0, from the full-state gain seen through C.
    xᵀPx is the cost from x; it is lowest from every x only if C sees all states.

    Raises:
        CirlError: if a gain on the way does not stabilise, or the iteration does not converge.
    """
    C_inverse = linalg.pinv(C)
    K = full_state_gain(A, B, Q, R)[0] @ C_inverse
    for _ in range(ITERATIONS):
        closed_loop = A - B @ K @ C
        _refuse_unstable(closed_loop, A, "output feedback does not stabilise")
        P = linalg.solve_continuous_lyapunov(closed_loop.T, -Q - C.T @ K.T @ R @ K @ C)
        before, K = K, linalg.solve(R, B.T @ P @ C_inverse)
        if np.abs(K - before).max() <= TOLERANCE * np.abs(K).max():
            return K, P
    raise CirlError(f"LQR: the gain of output feedback has not converged in {ITERATIONS} iterations")


@dataclass(kw_only=True, eq=False)
class LQR(Controller):
    """Linear-quadratic regulator: measures stocks, feeds them back, clips to the bounds of the controls.

    It reads the stocks from the environment it was started in, whatever the agents observe. Its gains are those of
    continuous time, while an action is held for a control interval (zero-order hold): the closed loop is the published
    one only if the interval is short against its time constants.

    Attributes:
        state_weight: Q, or its diagonal. None: 1/scale² of each measured stock; in the paper scenarios the papers'.
        input_weight: R, or its diagonal. None: 1/scale² of each flow; likewise.
        outputs: nodes whose stocks are measured, for output feedback. None: all states.
        set_points: node → stock, in place of the tracked set-points of the network.
        agents: whom it drives, the others being held neutral. None: every agent of the environment.
        system: once started, the network's linear laws.
        gain: once started, K, shape (inputs, measured stocks).
    """

    state_weight: ArrayLike | None = None
    input_weight: ArrayLike | None = None
    outputs: Sequence[str] | None = None
    set_points: Mapping[str, float] | None = None
    agents: Sequence[str] | None = None
    system: LinearSystem = field(init=False, repr=False)
    gain: Floats = field(init=False, repr=False)

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Keep ``env``, whose stocks it will measure, and find equilibrium and gain; ``seed`` is not used.

        Raises:
            CirlError: if an agent, output, weight or set-point does not fit, or the network cannot be regulated.
        """
        agents = env.agents if self.agents is None else _subset("agent", self.agents, env.agents)
        system = LinearSystem.of(env.network, agents, self.set_points)
        states, full = system.states, self.outputs is None
        outputs = states if self.outputs is None else _subset("output", self.outputs, states)
        C = np.eye(len(states))[[states.index(node) for node in outputs]]
        weights = system.scale**-2.0
        Q = _weight("state_weight", self.state_weight, C.T @ C @ weights[: len(states)], definite=False)
        R = _weight("input_weight", self.input_weight, weights[len(states) :], definite=True)
        gain, _ = full_state_gain(system.A, system.B, Q, R) if full else output_gain(system.A, system.B, C, Q, R)
        stocks, self._feed = system.equilibrium()
        self.system, self.gain, self._env, self._goal = system, gain, env, C @ stocks
        self._rows = [env.network.node_index[node] for node in outputs]

    def demand(self) -> Floats:
        """Return u = u_e − K (y − y_e) at the present stocks, before clipping, shape (inputs, B), mass/time."""
        distance = self._env.physical.stock[self._rows] - self._goal[:, None]
        return np.asarray(self._feed[:, None] - self.gain @ distance)

    def act(self, observations: Arrays) -> Arrays:
        """Return the actions that set the demanded flows, clipped to the bounds of the controls."""
        demand = zip(self.system.inputs, self.demand(), strict=True)
        return self._env.neutral_action | {agent: self._env.normalise(agent, flow[None]) for agent, flow in demand}


def _nonlinear(network: Network, agents: Sequence[str]) -> Iterator[str]:
    obstacles = {
        ControlKind.RATE: "rate controls multiply flows (bilinear)",
        ControlKind.SHARE: "shares multiply flows (bilinear)",
        ControlKind.TRANSFER: "transfers multiply flows of substances (bilinear)",
        ControlKind.INPUT: "inputs set no flows",
    }
    for kind, reason in obstacles.items():
        if bilinear := [a for a in agents if (control := network.compartments[a].control) and control.kind is kind]:
            yield f"{reason}: {', '.join(bilinear)}"
    reasons = {Law.COMPARTMENT: "inner physics drives", Law.BATCH: "batches move along"}
    for arc in network.arcs:
        if reason := reasons.get(arc.law, ""):
            yield f"{reason} '{arc.id}'"
    if network.orders:
        yield f"orders from nodes that store nothing, '{network.arcs[network.orders[0]].id}' for one, may be cut"
    if network.time_dependent:
        yield f"numbers change in time: {', '.join(network.time_dependent)}"


def _remedy(network: Network) -> str:
    """Say which agents leave a network linear, and where they can be chosen."""
    able = [agent for agent in network.controllable if not any(_nonlinear(network, [agent]))]
    variants = network.scenarios.items()
    linear = [name for name, scenario in variants if scenario.agents and not any(_nonlinear(scenario, scenario.agents))]
    if not able and not linear:
        return "No choice of agents makes it one"
    ways = [f"in Python agents={able}"] if able else []
    ways.append(f"on the command line --scenario {linear[0] if linear else 'NAME, one where only these act'}")
    return f"Let only agents act that set flows: {', '.join(ways)}"


def _targets(network: Network, set_points: Mapping[str, float] | None) -> dict[str, float]:
    tracked_nodes = network.objective.tracked or tuple(network.node_index)
    defaults = {
        node.id: node.set_point for node in network.nodes if node.set_point is not None and node.id in tracked_nodes
    }
    targets = defaults if set_points is None else dict(set_points)
    check_names("node", targets, network.node_index, "LQR: set_points: ")
    for node, value in targets.items():
        if not 0.0 <= value < np.inf:
            raise CirlError(f"LQR: set_points: '{node}' = {value} must be finite and not negative")
    return targets


def _subset(kind: str, names: Sequence[str], choices: Sequence[str]) -> tuple[str, ...]:
    check_names(kind, names or [""], choices, "LQR: ", ControlError)
    return tuple(dict.fromkeys(names))


def _weight(name: str, weights: ArrayLike | None, default: Floats, *, definite: bool) -> Floats:
    values = default if weights is None else np.asarray(weights, dtype=np.float64)
    matrix: Floats = np.diag(values) if values.ndim == 1 else values
    if matrix.shape == 2 * (len(default),) and np.isfinite(matrix).all() and (matrix == matrix.T).all():
        modes = linalg.eigvalsh(matrix)
        if modes[-1] > 0 and modes[0] > (RANK if definite else -RANK) * modes[-1]:
            return matrix
    kind = f"positive {'' if definite else 'semi-'}definite matrix, or its diagonal, of {len(default)} rows"
    raise ControlError(f"LQR: {name} must be a symmetric {kind}, not {weights!r}")


def _kalman(A: Floats, B: Floats) -> tuple[Floats, Floats]:
    """Return orthonormal bases of what control reaches and of the rest, shapes (n, r) and (n, n − r)."""
    basis, block = np.empty((len(A), 0)), B / max(linalg.norm(B), 1.0)
    while block.shape[1]:
        for _ in range(2):  # the second pass removes round-off along what is reached already
            block = block - basis @ (basis.T @ block)
        U, sizes, _ = linalg.svd(block, full_matrices=False)
        block = U[:, sizes > RANK]
        basis = np.hstack([basis, block])
        block = A @ block / max(linalg.norm(A), RANK)
    return basis, linalg.svd(basis)[0][:, basis.shape[1] :]


def _refuse_unstable(closed_loop: Floats, A: Floats, reason: str) -> None:
    for mode in linalg.eigvals(closed_loop):
        if mode.real > -DECAY * linalg.norm(A):
            raise CirlError(f"LQR: {reason} the mode with eigenvalue {mode:.6g}, which is not stable")
