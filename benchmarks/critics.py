"""What critics say an action is worth, held against exact slopes of the simulator.

python -m benchmarks.critics    # two trainings on carbo_net, minutes; writes the table of docs/study.md

TD3 learns from a first guess, with rewards as they are and less the mean of all copies. Then its policies play an
episode. By each action there are two slopes: that of the agent's critic, in units of reward, and that of the discounted
sum of rewards to come, others held (adjoint of the simulator). Actions at their bounds are left out.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.document import markdown_table, write_sections
from cirl_marl import MultiAgentVectorEnv, train
from cirl_marl.environments.derivatives import Derivatives, Outputs
from cirl_marl.environments.state import Interval
from cirl_marl.learners.learner import Learner
from cirl_marl.learners.policies import Policies
from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.learners.trainer import Training
from cirl_marl.network import Floats

DOCUMENT = Path(__file__).parent.parent / "docs" / "study.md"
NETWORK, RECIPE = "carbo_net", "guided_td3"
TUNING_SEED, EPISODE_SEED, COPIES, FIRST_STEPS = 0, 77, 8, 512_000
FREE = 0.98
"""Size of an action below which it can move either way."""


def recipe(centred: bool) -> Recipe:
    """Return the recipe, which learns from rewards as they are or centred."""
    plain = load_recipe(RECIPE).model_dump()
    plain["learner"] |= {"centre_rewards": centred}
    plain["learner"]["start"]["steps"] = FIRST_STEPS
    return Recipe.model_validate(plain)


def critic_slopes(learner: Learner, rows: Any, actions: NDArray[np.floating]) -> Floats:
    """Return derivatives of a critic by the action, shape (copies, entries), in units of reward."""
    model, normaliser = learner.model, learner.normaliser
    assert normaliser is not None
    inputs = torch.as_tensor(normaliser.normalize_obs(rows), dtype=torch.float32)
    acts = torch.as_tensor(actions, dtype=torch.float32).requires_grad_(True)
    (slopes,) = torch.autograd.grad(model.policy.critic(inputs, acts)[0].sum(), acts)  # type: ignore[operator]
    return slopes.numpy() * float(np.sqrt(normaliser.ret_rms.var + normaliser.epsilon))


def exact_slopes(env: MultiAgentVectorEnv, tape: list[Interval], discount: float) -> Floats:
    """Return derivatives of Σ_k γ^k r_{t+k} by the actions of interval t, shape (intervals, entries, copies)."""
    derivatives, after, weight = Derivatives(env), tape[-1].after, env.circularity_weight
    stock, paths = np.zeros_like(after.stock), np.zeros_like(after.disturbances)
    by_circularity = np.full(env.num_envs, weight / env.network.objective.circularity_scale)
    by_level = np.repeat([[service.weight * (1.0 - weight)] for service in env.network.services], env.num_envs, axis=1)
    accounts, slopes = np.zeros((len(env.network.accounts), env.num_envs)), list[Floats]()
    for interval in reversed(tape):
        outputs = Outputs(discount * stock, by_circularity, by_level, accounts=accounts)
        stock, by_action, _ = derivatives.pull_back(interval, outputs, paths)
        slopes.insert(0, by_action)
    return np.array(slopes)


def slopes_by_agent(training: Training) -> Mapping[str, tuple[Floats, Floats]]:
    """Return slopes of the critic and exact ones of each agent, at free actions of an episode by what was learnt."""
    learners, options = training.learners, training.config.options
    env = MultiAgentVectorEnv(training.env.network, num_envs=COPIES, **options)
    policies = Policies({name: learner.policy for name, learner in learners.items()})
    policies.start(env, EPISODE_SEED)
    observations, tape = env.reset(seed=EPISODE_SEED), list[Interval]()
    critics: dict[str, list[Floats]] = {name: [] for name in learners}
    taken: dict[str, list[NDArray[np.floating]]] = {name: [] for name in learners}
    for _ in range(env.network.episode.horizon):
        actions = policies.act(observations)
        for name, learner in learners.items():
            rows = learner.agent_env.view.observe(observations, env.state)
            critics[name].append(critic_slopes(learner, rows, actions[name]))
            taken[name].append(actions[name])
        observations = env.step(actions)[0]
        tape.append(env.interval)
    exact, pairs = exact_slopes(env, tape, load_recipe(RECIPE).learner.parameters["gamma"]), {}
    for name in learners:
        free = np.abs(np.array(taken[name])) < FREE
        pairs[name] = np.array(critics[name])[free], exact[:, env.actuators.entries[name]].swapaxes(1, 2)[free]
    return pairs


def main() -> None:
    """Train, and write the table."""
    rows = []
    for title, centred in (("as they are", False), ("less the mean of all copies", True)):
        pairs = slopes_by_agent(train(NETWORK, recipe(centred), seed=TUNING_SEED)).values()
        sizes = [np.sqrt([np.mean(part**2) for part in pair]) for pair in pairs]
        ratios = [critic / exact for critic, exact in sizes]
        cosines = [float(np.vdot(*pair) / np.prod([np.linalg.norm(part) for part in pair])) for pair in pairs]
        spread = f"{np.median(cosines):+.2f} ({min(cosines):+.2f} to {max(cosines):+.2f})"
        ratio_texts = [f"{float(f'{size:.2g}'):g}" for size in (np.median(ratios), min(ratios), max(ratios))]
        rows.append((title, "{} ({} to {})".format(*ratio_texts), spread))
        sys.stdout.write(f"{rows[-1]}\n")
    columns = ("rewards", "critics' slopes over exact ones", "cosine between them")
    write_sections(DOCUMENT, {"critics": markdown_table(columns, rows)})


if __name__ == "__main__":
    main()
