"""Rules that people can read: a small decision tree for each agent that does nearly what its policy does.

A regression tree is fitted to what the policy does in episodes of its own, then to what it would do in episodes in
which the trees act, so that these know what to do where they themselves lead.

References: Ross, Gordon and Bagnell 2011, A reduction of imitation learning and structured prediction to no-regret
online learning, AISTATS (DAgger); Breiman et al. 1984, Classification and Regression Trees.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from cirl_marl.controllers.basic import Arrays, Controller
from cirl_marl.controllers.rollout import Rollout, rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import optional_module
from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import frozen_record, positional_record
from cirl_marl.reasons.attribution import PairedDifference, paired_difference
from cirl_marl.reasons.input_signals import PolicyColumns, Signal, policy_columns, signal_of
from cirl_marl.reasons.interventions import RecordedEpisodes, Recorder, Substitution

if TYPE_CHECKING:
    from cirl_marl.learners.policies import Policies

LEAVES = 4
ROUNDS = 2
"""Times that trees act and are fitted anew to what the policies would have done."""
RELATIVE_GAIN, ABSOLUTE_GAIN = 2e-3, 5e-4
"""What a branch must explain at least: as part of the variance of an action, and in squares of actions in [−1, 1]."""
LEAF_SHARE = 0.01
"""Least part of all decisions that a leaf stands for."""


@dataclass(frozen=True, slots=True)
class Condition:
    """What holds on the way to a leaf: a signal above ``low`` and not above ``high``, as it is observed."""

    signal: Signal
    low: float
    high: float


@positional_record
class Leaf:
    """What an agent does under some conditions."""

    conditions: Annotated[tuple[Condition, ...], "all of them, one for each signal that is asked for"]
    action: Annotated[Floats, "normalised, shape (entries,)"]
    control: Annotated[Floats, "mean of what that is in the physical control, shape (entries,)"]
    share: Annotated[float, "part of the decisions that it stands for"]


@frozen_record
class Rule:
    """The tree of one agent."""

    agent: Annotated[str, "for whom it acts"]
    leaves: Annotated[tuple[Leaf, ...], "what it does when"]
    explained_variance: Annotated[
        float, "part of the variance of the policy's action that it explains; 1 if the action never changes"
    ]
    cost: Annotated[
        PairedDifference,
        "what changed in episodes in which it acted in the policy's place, and the others by their policies",
    ]


@frozen_record
class TeamRules:
    """The rules of all agents."""

    rules: Annotated[tuple[Rule, ...], "agent by agent"]
    together: Annotated[PairedDifference, "what changed in episodes in which all agents acted by their rules"]


class TreeController(Controller):
    """Acts for some agents by their trees; where it has none it does nothing."""

    def __init__(self, trees: Mapping[str, Any], columns: Mapping[str, PolicyColumns]) -> None:
        """Take a fitted tree for each agent, and where in the observations its features are."""
        self._trees, self._columns = trees, columns

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Get ready: there is nothing to remember."""

    def act(self, observations: Arrays) -> Arrays:
        """Return what the trees say, shape (B, entries) each."""
        actions = {}
        for agent, tree in self._trees.items():
            sources = self._columns[agent].sources
            features = np.stack([observations[member][:, entry] for member, entry in sources], axis=1)
            output = tree.predict(features.astype(np.float32))
            actions[agent] = np.clip(output.reshape(len(features), -1), -1.0, 1.0)
        return actions


@dataclass(frozen=True, slots=True)
class _Lessons:
    """What one agent saw in all recorded episodes, as trees keep it, what its policy did there, and in which step."""

    features: Floats
    actions: Floats
    steps: Integers


def _lessons(agent: str, columns: PolicyColumns, records: Sequence[RecordedEpisodes]) -> _Lessons:
    features, actions, steps = [], [], []
    for record in records:
        count, copies, entries = record.actions[agent].shape
        values = [record.observations[member][:, :, entry].ravel() for member, entry in columns.sources]
        features.append(np.stack(values, axis=1))
        actions.append(record.actions[agent].reshape(-1, entries))
        steps.append(np.repeat(np.arange(count), copies))
    return _Lessons(np.concatenate(features).astype(np.float32), np.concatenate(actions), np.concatenate(steps))


def sklearn_tree() -> Any:
    """Return ``sklearn.tree``; a ``CirlError`` says what to install."""
    return optional_module("sklearn.tree", "explanations of policies need scikit-learn", "explain")


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
    columns = {}
    for agent in env.agents:
        policy = next(policy for policy in policies.policies.values() if agent in policy.view.agents)
        columns[agent] = policy_columns(env, policy.view, agent)
    records: list[RecordedEpisodes] = []
    controller = TreeController({}, columns)
    work = ROUNDS + 1 + len(env.agents) + 1
    for round_ in range(ROUNDS + 1):
        recorder = Recorder(policies, controller if round_ else None)
        # starts between those of one evaluation and the next are nobody's
        rollout(env, recorder, seed=seed + (round_ + 1) * 100_000)
        records.append(recorder.episodes)
        lessons = {agent: _lessons(agent, columns[agent], records) for agent in env.agents}
        fitted_trees = {agent: _fit(lessons[agent], leaves) for agent in env.agents}
        controller = TreeController(fitted_trees, columns)
        progress((round_ + 1) / work)
    rules = []
    for a, agent in enumerate(env.agents):
        episodes = rollout(env, Substitution(policies, controller, [agent]), seed=seed)
        tree, lesson = fitted_trees[agent], lessons[agent]
        tree_leaves = _leaves(env, agent, tree, columns[agent].names, lesson)
        explained, cost = _explained_variance(tree, lesson), paired_difference(episodes, usual)
        rules.append(Rule(agent=agent, leaves=tree_leaves, explained_variance=explained, cost=cost))
        progress((ROUNDS + 2 + a) / work)
    together = paired_difference(rollout(env, controller, seed=seed), usual)
    progress(1.0)
    return TeamRules(rules=tuple(rules), together=together)


def _fit(lesson: _Lessons, leaves: int) -> Any:
    variance, actions = float(lesson.actions.var(axis=0).mean()), lesson.actions
    tree = sklearn_tree().DecisionTreeRegressor(
        max_leaf_nodes=max(2, leaves),
        min_samples_leaf=max(1, int(LEAF_SHARE * len(lesson.features))),
        min_impurity_decrease=max(RELATIVE_GAIN * variance, ABSOLUTE_GAIN),
        random_state=0,
    )
    return tree.fit(lesson.features, actions if actions.shape[1] > 1 else actions.ravel())


def _explained_variance(tree: Any, lesson: _Lessons) -> float:
    error = lesson.actions - tree.predict(lesson.features).reshape(lesson.actions.shape)
    variance = float(lesson.actions.var(axis=0).sum())
    return 1.0 - float((error**2).mean(axis=0).sum()) / variance if variance > 1e-12 else 1.0


def _leaves(
    env: MultiAgentVectorEnv, agent: str, tree: Any, names: Sequence[str], lesson: _Lessons
) -> tuple[Leaf, ...]:
    leaf_of, network = tree.apply(lesson.features), env.network
    low, _, high = network.control_bounds[:, network.control_rows[agent]]
    leaves = []
    for node, ranges in _paths(tree.tree_):
        decisions = leaf_of == node
        action = np.clip(tree.tree_.value[node].reshape(-1), -1.0, 1.0)
        steps = lesson.steps[decisions]
        control = low[:, steps] + (action[:, None] + 1) / 2 * (high - low)[:, steps]
        conditions = (Condition(signal_of(network, names[feature]), *ends) for feature, ends in sorted(ranges.items()))
        leaves.append(Leaf(tuple(conditions), action, control.mean(axis=1), float(decisions.mean())))
    return tuple(leaves)


def _paths(tree: Any) -> list[tuple[int, dict[int, tuple[float, float]]]]:
    """Return each leaf with the range of every feature that leads to it, from left to right."""
    leaves = []
    stack: list[tuple[int, dict[int, tuple[float, float]]]] = [(0, {})]
    while stack:
        node, ranges = stack.pop()
        lower, upper = int(tree.children_left[node]), int(tree.children_right[node])
        if lower < 0:
            leaves.append((node, ranges))
            continue
        feature, threshold = int(tree.feature[node]), float(tree.threshold[node])
        low, high = ranges.get(feature, (-np.inf, np.inf))
        stack.append((upper, {**ranges, feature: (max(low, threshold), high)}))
        stack.append((lower, {**ranges, feature: (low, min(high, threshold))}))
    return leaves
