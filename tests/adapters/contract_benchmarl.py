"""What BenchMARL gets: a task whose environments are those of TorchRL."""

from __future__ import annotations

import pickle

import pytest
import torch

from cirl_marl import CirlError, load_network
from cirl_marl.adapters.benchmarl import NetworkTask
from cirl_marl.adapters.torchrl import GROUP, TorchRLEnv


def test_the_task_makes_the_environment_of_torchrl() -> None:
    """With as many copies, the seed and the options that were asked for; it can be sent to another process."""
    task = pickle.loads(pickle.dumps(NetworkTask("copper_net", reward="team", horizon=5)))
    env = task.get_env_fun(3, True, 7, "cpu")()
    same = TorchRLEnv("copper_net", num_envs=3, seed=7, reward="team", horizon=5)
    assert torch.equal(env.reset()[GROUP, "observation"], same.reset()[GROUP, "observation"])
    assert task.max_steps(env) == 5 and task.group_map(env) == env.group_map
    assert task.group_map(env)[GROUP] == list(load_network("copper_net").agents)
    assert (
        task.observation_spec(env)[GROUP, "observation"].shape == env.observation_spec[GROUP, "observation"].shape[1:]
    )
    assert task.action_spec(env)[GROUP, "action"].shape == (16, 1)
    assert task.supports_continuous_actions() and not task.supports_discrete_actions()
    assert (task.name, task.env_name()) == ("copper_net", "cirl_marl")


def test_unknown_networks_are_refused_before_an_experiment() -> None:
    """When the task is made."""
    with pytest.raises(CirlError, match="Did you mean 'copper_net'"):
        NetworkTask("coper_net")
