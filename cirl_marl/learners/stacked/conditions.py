"""Which learners can run as one, and why others cannot."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from sb3_contrib import ARS, TQC
from sb3_contrib.ars.policies import ARSPolicy
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor

from cirl_marl.errors import CirlError, unknown_name
from cirl_marl.learners.learner import Learner
from cirl_marl.learners.policies import CentralCriticPolicy
from cirl_marl.learners.recipe import LearnerSettings, Run
from cirl_marl.learners.stacked.gradient_ascent import GradientStack
from cirl_marl.learners.stacked.on_policy import RolloutStack
from cirl_marl.learners.stacked.perceptrons import ACTIVATIONS, linear_layers, networks_of
from cirl_marl.learners.stacked.search import SearchStack, copies_per_candidate, parts_of
from cirl_marl.learners.stacked.stack import Stack

OPTIMISERS = (torch.optim.Adam, torch.optim.AdamW, torch.optim.RMSprop, torch.optim.SGD, RMSpropTFLike)
"""Optimisers that work element by element, so that zeros stay zero."""
SQUASHED = (TD3, DDPG, SAC, TQC)
"""Off-policy algorithms whose actors are perceptrons with bounded outputs."""
EXTRACTORS = {ActorCriticPolicy: FlattenExtractor, CentralCriticPolicy: CombinedExtractor}


def check_device(device: str) -> None:
    """Refuse a device on which torch cannot compute here.

    Raises:
        CirlError: naming it, and those of this machine.
    """
    try:
        torch.empty(0, device=torch.device(device))
    except (RuntimeError, TypeError, AssertionError) as error:  # the latter where torch is built without CUDA
        accelerators = {"cuda": torch.cuda, "mps": torch.backends.mps}
        present = [name for name, module in accelerators.items() if module.is_available()]
        raise CirlError(unknown_name("device of this machine", device, ["cpu", *present])) from error


def gradient_stacks(trainings: Iterable[Iterable[Learner]], device: str, run: Run) -> list[Stack]:
    """Return the learners of each training as one, which climb exact gradients as the recipe's ``run`` says."""
    return [GradientStack([*learners], device, run) for learners in trainings]


def gradient_obstacle(learner: Learner, settings: LearnerSettings) -> str | None:
    """Return why exact gradients cannot move a learner as they do one of ``settings``; None if they can."""
    model = learner.model
    if type(model) is PPO:
        reason = _on_policy_obstacle(model, learner.spec.policy)
    elif type(model) in SQUASHED:
        reason = _actor_obstacle(model)
    else:
        names = ", ".join(kind.__name__ for kind in (PPO, *SQUASHED))
        reason = f"algorithm {learner.spec.algorithm}: its policies are those of {names}"
    alike = {"kind", "role", "agents"}
    if reason is not None:
        return reason
    if learner.spec.scheme != "independent":
        return f"scheme {learner.spec.scheme}: each agent has a policy of its own"
    if learner.demonstrator is not None:
        return "demonstrations: there are none"
    if learner.spec.model_dump(exclude=alike) != settings.model_dump(exclude=alike):
        return "its settings: they must be those of all others, as the gradient goes through what all do"
    env = learner.agent_env.views[0].env
    if env.reward_mode != "team":
        return f"reward '{env.reward_mode}': what is climbed is that of 'team', with the mean of circularity"
    return None


def stacks(learners: Iterable[Learner], device: str) -> list[Stack]:
    """Return learners that can be stacked as one for each group of the same settings, rows and steps so far."""
    groups: dict[str, list[Learner]] = {}
    for learner in learners:
        settings = learner.spec.model_dump(exclude={"kind", "role", "agents"})
        key = f"{settings} {learner.agent_env.num_envs} {learner.model.num_timesteps}"
        groups.setdefault(key, []).append(learner)
    kinds = [SearchStack if isinstance(members[0].model, ARS) else RolloutStack for members in groups.values()]
    return [kind(members, device) for kind, members in zip(kinds, groups.values(), strict=True)]


def obstacle(learner: Learner) -> str | None:
    """Return why a learner cannot be stacked, in words that name what its recipe asks for; None if it can be."""
    model = learner.model
    if learner.demonstrator is not None:
        return "demonstrations: each learner imitates by itself"
    if type(model) in (PPO, A2C):
        assert isinstance(model, PPO | A2C)
        return _on_policy_obstacle(model, learner.spec.policy)
    if type(model) is ARS:
        return _search_obstacle(learner)
    return f"algorithm {learner.spec.algorithm} is not PPO, A2C or ARS"


def _on_policy_obstacle(model: PPO | A2C, policy_name: str) -> str | None:
    if model.use_sde:
        return "parameters.use_sde: noise that depends on the state is not stacked"
    if getattr(model, "target_kl", None) is not None:
        return "parameters.target_kl: learners of a stack cannot stop their epochs one by one"
    if type(model.rollout_buffer) not in (RolloutBuffer, DictRolloutBuffer):
        return f"parameters.rollout_buffer_class: {type(model.rollout_buffer).__name__} is the learner's own"
    policy = model.policy
    if type(policy) not in EXTRACTORS or type(policy.features_extractor) is not EXTRACTORS[type(policy)]:
        return f"policy {policy_name} with {type(policy.features_extractor).__name__}: only multilayer perceptrons are"
    if type(policy.action_dist) is not DiagGaussianDistribution:
        return f"parameters.policy_kwargs: actions are drawn from a {type(policy.action_dist).__name__}"
    if type(policy.optimizer) not in OPTIMISERS:
        return f"parameters.policy_kwargs: optimiser {type(policy.optimizer).__name__} is not element by element"
    networks = (policy.mlp_extractor.policy_net, policy.mlp_extractor.value_net)
    try:
        kinds = {linear_layers(network)[1] for network in networks}
    except TypeError as error:
        return f"parameters.policy_kwargs: {error}"
    if len(kinds - {None}) > 1 or not kinds <= {None, *ACTIVATIONS}:
        names = " or ".join(activation.__name__ for activation in ACTIVATIONS)
        return f"parameters.policy_kwargs: hidden layers are not linear with {names} between them"
    return None


def _actor_obstacle(model: BaseAlgorithm) -> str | None:
    """Return why exact gradients cannot move the actor of an off-policy algorithm; None if they can."""
    policy: Any = model.policy
    if getattr(model, "use_sde", False):
        return "parameters.use_sde: what acts is no perceptron with it"
    if type(policy.actor.features_extractor) is not FlattenExtractor:
        return f"features by {type(policy.actor.features_extractor).__name__}: only multilayer perceptrons are moved"
    if type(policy.actor.optimizer) not in OPTIMISERS:
        return f"parameters.policy_kwargs: optimiser {type(policy.actor.optimizer).__name__} is not element by element"
    try:
        activation = networks_of(policy).activation
    except TypeError as error:
        return f"parameters.policy_kwargs: {error}"
    if activation is not None and activation not in ACTIVATIONS:
        return f"parameters.policy_kwargs: activation {activation.__name__} is not one of Tanh, ReLU"
    return None


def _search_obstacle(learner: Learner) -> str | None:
    policy = learner.model.policy
    if not isinstance(policy, ARSPolicy):
        return f"policy {learner.spec.policy} is not one of ARS"
    try:
        parts_of(policy)
        copies_per_candidate(learner)
    except (TypeError, ValueError) as error:
        return f"parameters: {error}"
    return None
