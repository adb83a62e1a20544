"""Which learners can run as one, and why others cannot."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor

from cirl_marl.learners.central_critic import CentralCriticPolicy
from cirl_marl.learners.learner import Learner
from cirl_marl.learners.stacked.perceptrons import ACTIVATIONS, hidden_layers

ALGORITHMS = (PPO, A2C)
OPTIMISERS = (torch.optim.Adam, torch.optim.AdamW, torch.optim.RMSprop, torch.optim.SGD, RMSpropTFLike)
"""Optimisers that work element by element, so that zeros stay zero."""
EXTRACTORS = {ActorCriticPolicy: FlattenExtractor, CentralCriticPolicy: CombinedExtractor}


def obstacle(learner: Learner) -> str | None:
    """Return why a learner cannot be stacked, in words that name what its recipe asks for; None if it can be."""
    model, asked = learner.model, learner.spec
    if not isinstance(model, ALGORITHMS) or type(model) not in ALGORITHMS:
        return f"algorithm {asked.algorithm} is not {' or '.join(each.__name__ for each in ALGORITHMS)}"
    if model.use_sde:
        return "parameters.use_sde: noise that depends on the state is not stacked"
    if getattr(model, "target_kl", None) is not None:
        return "parameters.target_kl: learners of a stack cannot stop their epochs one by one"
    if type(model.rollout_buffer) not in (RolloutBuffer, DictRolloutBuffer):
        return f"parameters.rollout_buffer_class: {type(model.rollout_buffer).__name__} is the learner's own"
    policy = model.policy
    if type(policy) not in EXTRACTORS or type(policy.features_extractor) is not EXTRACTORS[type(policy)]:
        return f"policy {asked.policy} with {type(policy.features_extractor).__name__}: only multilayer perceptrons are"
    if type(policy.action_dist) is not DiagGaussianDistribution:
        return f"parameters.policy_kwargs: actions are drawn from a {type(policy.action_dist).__name__}"
    if type(policy.optimizer) not in OPTIMISERS:
        return f"parameters.policy_kwargs: optimiser {type(policy.optimizer).__name__} is not element by element"
    both = [hidden_layers(each) for each in (policy.mlp_extractor.policy_net, policy.mlp_extractor.value_net)]
    kinds = {layers[1] for layers in both if layers is not None and layers[1] is not None}
    if None in both or len(kinds) > 1 or not kinds <= set(ACTIVATIONS):
        known = " or ".join(each.__name__ for each in ACTIVATIONS)
        return f"parameters.policy_kwargs: hidden layers are not linear with {known} between them"
    return None


def alike(learners: Iterable[Learner]) -> list[list[Learner]]:
    """Return the learners that can run as one together: of the same settings and with as many rows."""
    found: dict[str, list[Learner]] = {}
    for learner in learners:
        settings = learner.spec.model_dump(exclude={"kind", "role", "agents"})
        key = f"{settings} {learner.seat.num_envs} {learner.model.num_timesteps}"
        found.setdefault(key, []).append(learner)
    return list(found.values())


def first_obstacle(learners: Sequence[Learner]) -> str | None:
    """Return what keeps the first learner that cannot be stacked from it; None if all can be."""
    return next(
        (f"{each.seat.title}: engine stacked: {why}" for each in learners if (why := obstacle(each)) is not None), None
    )
