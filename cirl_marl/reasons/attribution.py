"""What each agent looks at: integrated gradients of its action, and what becomes of λ̄ when that is hidden from it.

With F the policy, x what it sees and x' the mean of that over the episodes, integrated gradients give each input

    IG_i = (x_i − x'_i) · ∫_0^1 ∂F/∂x_i(x' + α (x − x')) dα,    Σ_i IG_i = F(x) − F(x').

References: Sundararajan, Taly and Yan 2017, Axiomatic attribution for deep networks, ICML (arXiv 1703.01365).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from cirl_marl.controllers.rollout import Rollout, rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import optional_module
from cirl_marl.evaluation.statistics import Aggregate, over_episodes
from cirl_marl.network import Floats
from cirl_marl.network.declarations import frozen_record
from cirl_marl.reasons.input_signals import Signal, observation_entries, policy_columns, signal_of
from cirl_marl.reasons.interventions import FixedInputs, RecordedEpisodes, Substitution

if TYPE_CHECKING:
    from cirl_marl.learners.policies import Policies, Policy

SAMPLES = 512
"""Most decisions of an agent that are looked at."""
POINTS = 32
"""Points of the Gauss-Legendre rule between the mean and what was seen."""


@frozen_record
class PairedDifference:
    """How episodes differ from those of the policies from the same starts: means with 95 % intervals over episodes."""

    circularity: Annotated[Aggregate, "of λ̄, mass"]
    service: Annotated[Aggregate, "of the mean service level"]
    usual: Annotated[float, "mean λ̄ of the policies, mass"]


@frozen_record
class AgentInputs:
    """What one agent looks at, first what counts most."""

    agent: Annotated[str, "whose action it is"]
    signals: Annotated[tuple[Signal, ...], "what it sees, each once"]
    share: Annotated[Floats, "mean size of each input's attribution, as part of all, shape (signals,)"]
    slope: Annotated[
        Floats,
        "change of the action, [−1, 1], with the input, per unit of the input in its observation, by least squares of "
        "attributions on distances from the mean, shape (entries, signals)",
    ]
    residual: Annotated[float, "mean distance of Σ IG from F(x) − F(x'), as part of the mean size of the latter"]
    top: Annotated[int, "how many of the first inputs were held"]
    top_held: Annotated[PairedDifference, "what changed when those were held at their means"]
    least_held: Annotated[
        PairedDifference | None,
        "what changed when as many of the last inputs were; None where there are no others",
    ]


def captum() -> Any:
    """Return ``captum.attr``; a ``CirlError`` says what to install."""
    return optional_module("captum.attr", "explanations of policies need captum", "explain")


def paired_difference(episodes: Rollout, usual: Rollout) -> PairedDifference:
    """Return how episodes differ from those to which they are compared, start by start."""
    return PairedDifference(
        circularity=over_episodes(episodes.episode_circularity - usual.episode_circularity),
        service=over_episodes(episodes.episode_service - usual.episode_service),
        usual=float(usual.episode_circularity.mean()),
    )


def attribute_inputs(
    env: MultiAgentVectorEnv,
    policies: Policies,
    twins: Policies,
    record: RecordedEpisodes,
    usual: Rollout,
    seed: int,
    *,
    top: int = 3,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[AgentInputs, ...]:
    """Attribute what each agent does to what it sees, and hold the inputs that count most.

    Args:
        env: as many copies as episodes.
        policies: who acts.
        twins: the same policies once more, to act on inputs that are held.
        record: what they saw and did in those episodes.
        usual: the episodes.
        seed: of their starts.
        top: how many inputs are held together.
        progress: called with the share that is done.

    Raises:
        CirlError: if captum is not installed.
    """

    def difference_if_held(policy: Policy, agent: str, names: Sequence[str]) -> PairedDifference:
        constants = {}
        for member in policy.view.agents:
            entries = observation_entries(env, member, names)
            constants[member] = entries, record.observations[member].mean(axis=(0, 1))[entries]
        controller = Substitution(policies, FixedInputs(twins, constants), [agent])
        return paired_difference(rollout(env, controller, seed=seed), usual)

    attributions = []
    for place, agent in enumerate(env.agents):
        name, policy = next(pair for pair in policies.policies.items() if agent in pair[1].view.agents)
        share, slope, residual = _integrated_gradients(env, name, policy, agent, record)
        order = np.argsort(-share, kind="stable")
        names = [policy_columns(env, policy.view, agent).names[i] for i in order]
        least = names[top:][-top:]
        attributions.append(
            AgentInputs(
                agent=agent,
                signals=tuple(signal_of(env.network, name) for name in names),
                share=share[order],
                slope=slope[:, order],
                residual=residual,
                top=min(top, len(names)),
                top_held=difference_if_held(policy, agent, names[:top]),
                least_held=difference_if_held(policy, agent, least) if least else None,
            )
        )
        progress((place + 1) / len(env.agents))
    return tuple(attributions)


def _integrated_gradients(
    env: MultiAgentVectorEnv, name: str, policy: Policy, agent: str, record: RecordedEpisodes
) -> tuple[Floats, Floats, float]:
    """Return shares, slopes and the residual, for the signals of ``policy_columns``."""
    import torch

    from cirl_marl.learners.policies import DifferentiablePolicy

    function, view, columns = DifferentiablePolicy(policy), policy.view, policy_columns(env, policy.view, agent)
    observations = {member: record.observations[member] for member in view.agents}
    flat: dict[str, Floats] = {member: rows.reshape(-1, rows.shape[2]) for member, rows in observations.items()}
    count = len(flat[agent])
    place = view.row_agents.index(agent) if view.row_agents else 0
    rows = np.asarray(view.rows(flat), dtype=np.float32)[place * count : (place + 1) * count]
    sample = np.unique(np.linspace(0, count - 1, min(count, SAMPLES)).round().astype(int))
    memory: tuple[torch.Tensor, ...] = ()
    if function.remembers:
        states = _memories(record.memories[name], env.num_envs, place)
        memory = tuple(torch.as_tensor(state[sample]) for state in states)
    mean = rows.mean(axis=0, keepdims=True)
    inputs, baseline = torch.as_tensor(rows[sample]), torch.as_tensor(np.repeat(mean, len(sample), axis=0))
    method = captum().IntegratedGradients(function)
    distance = (rows[sample] - mean)[:, [places[0] for places in columns.places]].astype(float)
    squares = (distance**2).sum(axis=0)
    sizes, slopes, residuals = np.zeros(len(columns.names)), [], []
    options: dict[str, Any] = {"method": "gausslegendre", "n_steps": POINTS, "internal_batch_size": SAMPLES * POINTS}
    options |= {"additional_forward_args": memory or None}
    for entry in columns.entries.tolist():
        gradients, delta = method.attribute(inputs, baseline, target=entry, return_convergence_delta=True, **options)
        with torch.no_grad():
            change = (function(inputs, *memory) - function(baseline, *memory))[:, entry]
        parts = gradients.detach().numpy().astype(float)
        # a signal may stand in several columns of the row
        by_signal = np.stack([parts[:, places].sum(axis=1) for places in columns.places], axis=1)
        sizes += np.abs(by_signal).mean(axis=0)
        products = (by_signal * distance).sum(axis=0)
        slopes.append(np.divide(products, squares, out=np.zeros(len(squares)), where=squares > 0))
        size = float(change.abs().mean())
        residuals.append(float(delta.abs().mean()) / size if size > 0 else 0.0)
    total = sizes.sum()
    return sizes / total if total > 0 else sizes, np.array(slopes), float(np.mean(residuals))


def _memories(states: Sequence[object], copies: int, place: int) -> tuple[Floats, Floats]:
    """Return hidden and cell states before each decision of an agent, shape (steps · copies, layers, units) each."""
    first = next(state for state in states if state is not None)
    rows = slice(place * copies, (place + 1) * copies)
    parts = []
    for part in range(2):
        arrays = [np.zeros_like(first[part]) if state is None else state[part] for state in states]  # type: ignore[index]
        parts.append(np.concatenate([np.asarray(array)[:, rows].transpose(1, 0, 2) for array in arrays]))
    return parts[0], parts[1]
