"""Rules that people can read: a small decision tree for each agent that does nearly what its policy does.

A regression tree is fitted to what the policy does in episodes of its own, then to what it would do in episodes in
which the trees act, so that these know what to do where they themselves lead.

References: Ross, Gordon and Bagnell 2011, A reduction of imitation learning and structured prediction to no-regret
online learning, AISTATS (DAgger); Breiman et al. 1984, Classification and Regression Trees.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cirl_marl.controllers.basic import Arrays, Controller
from cirl_marl.controllers.rollout import Rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.network import Floats
from cirl_marl.reasons.attribution import PairedDifference, paired_difference
from cirl_marl.reasons.extras import trees
from cirl_marl.reasons.interventions import RecordedEpisodes, Recorder, Substitution, play_episodes
from cirl_marl.reasons.observations import Signal, policy_columns, signal_of

if TYPE_CHECKING:
    from cirl_marl.learners.policies import Policies

LEAVES = 4
ROUNDS = 2
"""Times that trees act and are fitted anew to what the policies would have done."""
WORTH, NOTICED = 2e-3, 5e-4
"""What a branch must explain at least: as part of the variance of an action, and in squares of actions in [−1, 1]."""
FEWEST = 0.01
"""Least part of all decisions that a leaf stands for."""


@dataclass(frozen=True, slots=True)
class Condition:
    """What holds on the way to a leaf: a signal above ``low`` and not above ``high``, as it is observed."""

    signal: Signal
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Leaf:
    """What an agent does under some conditions.

    Attributes:
        conditions: all of them, one for each signal that is asked for.
        action: normalised, shape (entries,).
        control: mean of what that is in the physical control, shape (entries,).
        share: part of the decisions that it stands for.
    """

    conditions: tuple[Condition, ...]
    action: Floats
    control: Floats
    share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """The tree of one agent.

    Attributes:
        agent: for whom it acts.
        leaves: what it does when.
        explained_variance: part of the variance of the policy's action that it explains; 1 if the action never changes.
        cost: what changed in episodes in which it acted in the policy's place, and the others by their policies.
    """

    agent: str
    leaves: tuple[Leaf, ...]
    explained_variance: float
    cost: PairedDifference


@dataclass(frozen=True, slots=True, kw_only=True)
class TeamRules:
    """The rules of all agents.

    Attributes:
        rules: agent by agent.
        together: what changed in episodes in which all agents acted by their rules.
    """

    rules: tuple[Rule, ...]
    together: PairedDifference


class TreeController(Controller):
    """Acts for some agents by their trees; where it has none it does nothing."""

    def __init__(self, grown: Mapping[str, Any], seen: Mapping[str, Sequence[tuple[str, int]]]) -> None:
        """Take a fitted tree for each agent, and where in the observations its features are."""
        self._grown, self._seen = grown, seen

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Get ready: there is nothing to remember."""

    def act(self, observations: Arrays) -> Arrays:
        """Return what the trees say, shape (B, entries) each."""
        found = {}
        for agent, tree in self._grown.items():
            features = np.stack([observations[whose][:, entry] for whose, entry in self._seen[agent]], axis=1)
            acted = tree.predict(features.astype(np.float32))
            found[agent] = np.clip(acted.reshape(len(features), -1), -1.0, 1.0)
        return found


def distil_rules(
    env: MultiAgentVectorEnv,
    policies: Policies,
    usual: Rollout,
    seed: int,
    *,
    leaves: int = LEAVES,
    progress: Callable[[float], None] = lambda share: None,
) -> TeamRules:
    """Distil the policies into rules, and let these act.

    Args:
        env: as many copies as episodes.
        policies: who acts.
        usual: episodes of the policies, from the starts of ``seed``.
        seed: of the episodes in which the rules are judged; they are fitted in others.
        leaves: most leaves of a tree.
        progress: called with the share that is done.

    Raises:
        CirlError: if scikit-learn is not installed.
    """
    where = {}
    for agent in env.agents:
        policy = next(each for each in policies.policies.values() if agent in each.view.agents)
        where[agent] = policy_columns(env, policy.view, agent)
    places = {agent: each.seen for agent, each in where.items()}
    watched: list[RecordedEpisodes] = []
    grown: dict[str, Any] = {}
    work = ROUNDS + 1 + len(env.agents) + 1
    for round_ in range(ROUNDS + 1):
        watching = Recorder(policies, TreeController(grown, places) if round_ else None)
        # starts between those of one evaluation and the next are nobody's
        play_episodes(env, watching, seed + (round_ + 1) * 100_000)
        watched.append(watching.seen)
        grown = {agent: _grown(agent, watched, places[agent], leaves) for agent in env.agents}
        progress((round_ + 1) / work)
    tree, found = TreeController(grown, places), []
    for a, agent in enumerate(env.agents):
        cost = paired_difference(play_episodes(env, Substitution(policies, {agent: tree}), seed), usual)
        names = where[agent].names
        found.append(
            Rule(
                agent=agent,
                leaves=_leaves(env, agent, grown[agent], names, places[agent], watched),
                explained_variance=_explained_variance(grown[agent], agent, places[agent], watched),
                cost=cost,
            )
        )
        progress((ROUNDS + 2 + a) / work)
    together = paired_difference(play_episodes(env, tree, seed), usual)
    progress(1.0)
    return TeamRules(rules=tuple(found), together=together)


def _table(agent: str, watched: Sequence[RecordedEpisodes], places: Sequence[tuple[str, int]]) -> tuple[Floats, Floats]:
    """Return all features that an agent saw, as trees keep them, and what its policy did."""
    features = [
        np.stack([each.observations[whose][:, :, entry].ravel() for whose, entry in places], axis=1) for each in watched
    ]
    actions = [each.actions[agent].reshape(-1, each.actions[agent].shape[2]) for each in watched]
    return np.concatenate(features).astype(np.float32), np.concatenate(actions)


def _grown(agent: str, watched: Sequence[RecordedEpisodes], places: Sequence[tuple[str, int]], leaves: int) -> Any:
    features, actions = _table(agent, watched, places)
    variance = float(actions.var(axis=0).mean())
    tree = trees().DecisionTreeRegressor(
        max_leaf_nodes=max(2, leaves),
        min_samples_leaf=max(1, int(FEWEST * len(features))),
        min_impurity_decrease=max(WORTH * variance, NOTICED),
        random_state=0,
    )
    return tree.fit(features, actions if actions.shape[1] > 1 else actions.ravel())


def _explained_variance(
    tree: Any, agent: str, places: Sequence[tuple[str, int]], watched: Sequence[RecordedEpisodes]
) -> float:
    features, actions = _table(agent, watched, places)
    left = actions - tree.predict(features).reshape(actions.shape)
    variance = float(actions.var(axis=0).sum())
    return 1.0 - float((left**2).mean(axis=0).sum()) / variance if variance > 1e-12 else 1.0


def _leaves(
    env: MultiAgentVectorEnv,
    agent: str,
    tree: Any,
    names: Sequence[str],
    places: Sequence[tuple[str, int]],
    watched: Sequence[RecordedEpisodes],
) -> tuple[Leaf, ...]:
    features, _ = _table(agent, watched, places)
    steps = np.concatenate([np.repeat(np.arange(len(each.actions[agent])), env.num_envs) for each in watched])
    reached, grown = tree.apply(features), tree.tree_
    network = env.network
    rows = network.control_rows[agent]
    low, _, high = network.control_bounds[:, rows]
    found = []
    for leaf, ways in _ways(grown):
        at = reached == leaf
        action = np.clip(grown.value[leaf].reshape(-1), -1.0, 1.0)
        held = low[:, steps[at]] + (action[:, None] + 1) / 2 * (high - low)[:, steps[at]]
        conditions = tuple(
            Condition(signal_of(network, names[feature]), *ends) for feature, ends in sorted(ways.items())
        )
        found.append(Leaf(conditions, action, held.mean(axis=1), float(at.mean())))
    return tuple(found)


def _ways(grown: Any) -> list[tuple[int, dict[int, tuple[float, float]]]]:
    """Return each leaf with the range of every feature that leads to it."""
    found: list[tuple[int, dict[int, tuple[float, float]]]] = []

    def go(node: int, ranges: dict[int, tuple[float, float]]) -> None:
        left, right = int(grown.children_left[node]), int(grown.children_right[node])
        if left < 0:
            found.append((node, ranges))
            return
        feature, threshold = int(grown.feature[node]), float(grown.threshold[node])
        low, high = ranges.get(feature, (-np.inf, np.inf))
        go(left, {**ranges, feature: (low, min(high, threshold))})
        go(right, {**ranges, feature: (max(low, threshold), high)})

    go(0, {})
    return found
