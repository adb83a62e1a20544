"""What each agent looks at: integrated gradients of its action, and what becomes of λ̄ when that is hidden from it.

With F the policy, x what it sees and x' the mean of that over the episodes, integrated gradients give each input

    IG_i = (x_i − x'_i) · ∫_0^1 ∂F/∂x_i(x' + α (x − x')) dα,    Σ_i IG_i = F(x) − F(x').

References: Sundararajan, Taly and Yan 2017, Axiomatic attribution for deep networks, ICML (arXiv 1703.01365).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cirl_marl.controllers.rollout import Rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.evaluation.statistics import Aggregate, over_episodes
from cirl_marl.network import Floats, Integers
from cirl_marl.reasons.extras import captum
from cirl_marl.reasons.interventions import FixedInputs, RecordedEpisodes, Substitution, play_episodes
from cirl_marl.reasons.observations import Signal, observation_entries, policy_columns, signal_of

if TYPE_CHECKING:
    from cirl_marl.learners.policies import Policies, Policy

SAMPLES = 512
"""Most decisions of an agent that are looked at."""
POINTS = 32
"""Points of the Gauss-Legendre rule between the mean and what was seen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairedDifference:
    """How episodes differ from those of the policies from the same starts: means with 95 % intervals over episodes.

    Attributes:
        circularity: of λ̄, mass.
        service: of the mean service level.
        usual: mean λ̄ of the policies, mass.
    """

    circularity: Aggregate
    service: Aggregate
    usual: float


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentInputs:
    """What one agent looks at, first what counts most.

    Attributes:
        agent: whose action it is.
        signals: what it sees, each once.
        share: mean size of each input's attribution, as part of all, shape (signals,).
        slope: change of the action, [−1, 1], with the input, per unit of the input in its observation, by least
            squares of attributions on distances from the mean, shape (entries, signals).
        missed: mean distance of Σ IG from F(x) − F(x'), as part of the mean size of the latter.
        top: how many of the first inputs were held.
        top_held: what changed when those were held at their means.
        least_held: what changed when as many of the last inputs were; None where there are no others.
    """

    agent: str
    signals: tuple[Signal, ...]
    share: Floats
    slope: Floats
    missed: float
    top: int
    top_held: PairedDifference
    least_held: PairedDifference | None


def paired_difference(run: Rollout, usual: Rollout) -> PairedDifference:
    """Return how episodes differ from those to which they are compared, start by start."""
    return PairedDifference(
        circularity=over_episodes(run.episode_circularity - usual.episode_circularity),
        service=over_episodes(run.episode_service - usual.episode_service),
        usual=float(usual.episode_circularity.mean()),
    )


def attribute_inputs(
    env: MultiAgentVectorEnv,
    policies: Policies,
    again: Policies,
    seen: RecordedEpisodes,
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
        again: the same policies once more, to act on what is held.
        seen: what they saw and did in those episodes.
        usual: the episodes.
        seed: of their starts.
        top: how many inputs are held together.
        progress: called with the share that is done.

    Raises:
        CirlError: if captum is not installed.
    """
    found = []
    for place, agent in enumerate(env.agents):
        name, policy = next(each for each in policies.policies.items() if agent in each[1].view.agents)
        where = policy_columns(env, policy.view, agent)
        share, slope, missed = _attributed(env, name, policy, agent, seen)
        order = np.argsort(-share, kind="stable")
        count = min(top, len(order))
        outcomes = []
        for which in (order[:count], order[count:][-count:]):
            names = [where.names[i] for i in which]
            held = {each: _means(env, each, names, seen) for each in policy.view.agents}
            other = FixedInputs(again, held)
            run = play_episodes(env, Substitution(policies, {agent: other}), seed) if names else usual
            outcomes.append(paired_difference(run, usual) if names else None)
        assert outcomes[0] is not None
        found.append(
            AgentInputs(
                agent=agent,
                signals=tuple(signal_of(env.network, where.names[i]) for i in order),
                share=share[order],
                slope=slope[:, order],
                missed=missed,
                top=count,
                top_held=outcomes[0],
                least_held=outcomes[1],
            )
        )
        progress((place + 1) / len(env.agents))
    return tuple(found)


def _means(env: MultiAgentVectorEnv, agent: str, names: list[str], seen: RecordedEpisodes) -> tuple[Integers, Floats]:
    entries = observation_entries(env, agent, names)
    return entries, seen.observations[agent].mean(axis=(0, 1))[entries]


def _attributed(
    env: MultiAgentVectorEnv, name: str, policy: Policy, agent: str, seen: RecordedEpisodes
) -> tuple[Floats, Floats, float]:
    """Return shares, slopes and what is missed, for the signals of ``columns``."""
    import torch

    from cirl_marl.learners.policies import DifferentiablePolicy

    acting, view, where = DifferentiablePolicy(policy), policy.view, policy_columns(env, policy.view, agent)
    flat: Mapping[str, Floats] = {
        each: seen.observations[each].reshape(-1, seen.observations[each].shape[2]) for each in view.agents
    }
    count = len(flat[agent])
    place = view.row_agents.index(agent) if view.row_agents else 0
    rows = np.asarray(view.rows(flat), dtype=np.float32)[place * count : (place + 1) * count]
    chosen = np.unique(np.linspace(0, count - 1, min(count, SAMPLES)).round().astype(int))
    memory: tuple[torch.Tensor, ...] = ()
    if acting.remembers:
        memory = tuple(torch.as_tensor(each[chosen]) for each in _memories(seen.memories[name], env.num_envs, place))
    mean = rows.mean(axis=0, keepdims=True)
    taken, baseline = torch.as_tensor(rows[chosen]), torch.as_tensor(np.repeat(mean, len(chosen), axis=0))
    method = captum().IntegratedGradients(acting)
    sizes, slopes, missed = np.zeros(len(where.names)), [], []
    for entry in where.entries.tolist():
        given, delta = method.attribute(
            taken,
            baseline,
            target=entry,
            additional_forward_args=memory or None,
            n_steps=POINTS,
            method="gausslegendre",
            internal_batch_size=SAMPLES * POINTS,
            return_convergence_delta=True,
        )
        with torch.no_grad():
            change = (acting(taken, *memory) - acting(baseline, *memory))[:, entry]
        parts = given.detach().numpy().astype(float)
        by_signal = np.stack([parts[:, each].sum(axis=1) for each in where.places], axis=1)
        sizes += np.abs(by_signal).mean(axis=0)
        distance = (rows[chosen] - mean)[:, [each[0] for each in where.places]].astype(float)
        squares = (distance**2).sum(axis=0)
        slopes.append(
            np.divide((by_signal * distance).sum(axis=0), squares, out=np.zeros(len(squares)), where=squares > 0)
        )
        size = float(change.abs().mean())
        missed.append(float(delta.abs().mean()) / size if size > 0 else 0.0)
    total = sizes.sum()
    return sizes / total if total > 0 else sizes, np.array(slopes), float(np.mean(missed))


def _memories(kept: list[object], copies: int, place: int) -> tuple[Floats, Floats]:
    """Return hidden and cell states before each decision of an agent, shape (steps · copies, layers, units) each."""
    known = next(each for each in kept if each is not None)
    found = []
    for part in range(2):
        states = [np.zeros_like(known[part]) if each is None else each[part] for each in kept]  # type: ignore[index]
        mine = [np.asarray(each)[:, place * copies : (place + 1) * copies].transpose(1, 0, 2) for each in states]
        found.append(np.concatenate(mine))
    return found[0], found[1]
