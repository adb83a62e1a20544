"""Learner recipes: the catalogue is valid, mistakes are named, the published schema is up to date."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import pytest

import cirl_marl
from cirl_marl import DefinitionError, RecipeError
from cirl_marl.catalogue import folder
from cirl_marl.learners import Recipe, load_recipe, train
from cirl_marl.learners.algorithms import algorithms, checked_parameters, parameters_of
from cirl_marl.learners.recipe import Learner, Normalisation, recipe_schema

GOOD = """
name = "mine"
title = "a recipe"
[learner]
algorithm = "PPO"
parameters = { n_steps = 8 }
"""


def write(tmp_path: Path, text: str) -> Path:
    """Write a recipe file."""
    path = tmp_path / "recipe.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", cirl_marl.recipes())
def test_catalogue_is_valid(name: str) -> None:
    """Each recipe reads, fits its schema, and gives every agent of every network a learner."""
    recipe = load_recipe(name)
    assert recipe.name == name
    document = tomllib.loads((folder("agents") / f"{name}.toml").read_text())
    jsonschema.validate(document, recipe_schema())
    for network in map(cirl_marl.load_network, cirl_marl.networks()):
        recipe.check_agents(network.agents)
        assert all(recipe.learner_of(agent, network).algorithm in algorithms() for agent in network.agents)


def test_mixed_recipe_mixes() -> None:
    """Different kinds of compartments get different algorithms."""
    recipe, network = load_recipe("mixed_by_kind"), cirl_marl.load_network("copper_net")
    chosen = {agent: recipe.learner_of(agent, network).algorithm for agent in network.agents}
    assert (chosen["mine"], chosen["use"], chosen["use_to_collection"]) == ("SAC", "PPO", "TRPO")


def test_published_schema_is_up_to_date() -> None:
    """``agents/recipe.schema.json`` is what the code gives."""
    published = json.loads((folder("agents") / "recipe.schema.json").read_text())
    assert published == recipe_schema()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"PPO"', '"PPPO"', "learner.algorithm: unknown algorithm 'PPPO'. Did you mean 'PPO'?"),
        ("n_steps", "n_step", "unknown parameter of PPO 'n_step'. Did you mean 'n_steps'?"),
        ("[learner]", "[lerner]", "unknown key 'lerner'. Did you mean 'learner'?"),
        ("title", "titel", "unknown key 'titel'. Did you mean 'title'?"),
        ("[learner]", '[environment]\nrewrad = "local"\n[learner]', "unknown option 'rewrad'. Did you mean 'reward'?"),
        (
            "[learner]",
            '[[match]]\nalgorithm = "SAC"\n[learner]',
            "match.0: fits every agent; give kind,",
        ),
        (
            '"PPO"\nparameters = { n_steps = 8',
            '"SAC"\nparameters = { action_noise = 3',
            "needs kind and a number sigma, got 3",
        ),
        (
            '"PPO"\nparameters = { n_steps = 8',
            '"SAC"\nparameters = { action_noise = { kind = "nrmal", sigma = 1 }',
            "unknown kind 'nrmal'. Did you mean 'normal'?",
        ),
        ("[learner]", "[run]\nsteps = 0\n[learner]", "run.steps: Input should be greater than 0, got 0"),
        ("[learner]", '[learner]\npolicy = "MlpPolcy"', "unknown policy of PPO for vectors 'MlpPolcy'. Did you mean"),
        ("n_steps = 8", "learning_rate = { linear_from = 1e-3 }", "learning_rate: needs a number, or linear_from and"),
        ("n_steps = 8", 'batch_size = "a"', "parameters.batch_size: PPO needs int, got 'a'"),
        ("n_steps = 8", "n_epochs = 2.5", "parameters.n_epochs: PPO needs int, got 2.5"),
        ("n_steps = 8", "gamma = true", "parameters.gamma: PPO needs float, got True"),
        ("n_steps = 8", "target_kl = [1.0]", "parameters.target_kl: PPO needs float | None, got [1.0]"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    """Each mistake is an error that names file, key, value and the nearest valid name."""
    assert load_recipe(write(tmp_path, GOOD)).name == "mine"
    path = write(tmp_path, GOOD.replace(old, new))
    with pytest.raises(DefinitionError) as raised:
        load_recipe(path)
    assert str(path) in str(raised.value)
    assert message in str(raised.value)


def test_mistakes_that_need_the_network_are_named(tmp_path: Path) -> None:
    """Unknown agents, and values that the algorithm refuses, are errors before anything is trained or written."""
    path = write(tmp_path, GOOD + '[[match]]\nagents = ["mien"]\nalgorithm = "A2C"\n')
    with pytest.raises(RecipeError, match=r"unknown agent 'mien'\. Did you mean 'mine'"):
        train("copper_net", path, directory=tmp_path / "run")
    for refused in ("n_steps = 1", "batch_size = 0", "policy_kwargs = { net_ach = [8] }"):
        path = write(tmp_path, GOOD.replace("n_steps = 8", refused))
        with pytest.raises(RecipeError, match="agent 'refinery': PPO refuses its parameters"):
            train("copper_net", path, envs=1, directory=tmp_path / "run")
    with pytest.raises(cirl_marl.CirlError, match=r"unknown option 'observ'\. Did you mean 'observe'"):
        train("copper_net", write(tmp_path, GOOD), observ="full")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"environment": {"rewrad": "local"}}, "unknown option 'rewrad'. Did you mean 'reward'"),
        ({"environment": {"num_envs": 3}}, "unknown option 'num_envs'"),
        ({"learner": Learner(algorithm="SAC", policy="CentralCriticPolicy")}, "unknown policy of SAC"),
        (
            {
                "learner": Learner(
                    algorithm="PPO", policy="CentralCriticPolicy", normalise=Normalisation(observation=False)
                )
            },
            "sees physical units",
        ),
        ({"learner": Learner(algorithm="PPP")}, "unknown algorithm 'PPP'"),
    ],
)
def test_recipes_of_python_are_checked_like_files(changes: dict[str, Any], message: str, ppo_recipe: Recipe) -> None:
    """A recipe object with a mistake is refused by name, before anything is trained."""
    with pytest.raises(RecipeError, match=message):
        train("copper_net", ppo_recipe.model_copy(update=changes))


def test_lists_stand_for_tuples() -> None:
    """TOML has no tuples; the library takes some parameters as such."""
    checked_parameters("SAC", {"train_freq": [1, "episode"]})
    with pytest.raises(RecipeError, match=r"train_freq: SAC needs int \| tuple\[int, str\]"):
        checked_parameters("SAC", {"train_freq": ["episode", 1]})


def test_parameters_are_those_of_the_library() -> None:
    """Recipes may set what the constructors take, and nothing that the training sets itself."""
    assert {"learning_rate", "gamma", "n_steps"} <= set(parameters_of("PPO"))
    assert not {"env", "seed", "device"} & set(parameters_of("SAC"))
    assert {"PPO", "A2C", "SAC", "TD3", "DDPG", "TQC", "ARS", "TRPO"} <= set(algorithms())
    for name in algorithms():
        checked_parameters(name, {key: parameter.default for key, parameter in parameters_of(name).items()})
