"""Learner recipes: the catalogue is valid, mistakes are named, the published schema is up to date."""

from __future__ import annotations

import inspect
import json
import tomllib
from pathlib import Path
from typing import Any, cast, get_args

import jsonschema
import numpy as np
import pytest
import torch
from small_networks import ONE_OF_EACH

import cirl_marl
from cirl_marl import CirlError, DefinitionError, MultiAgentVectorEnv, RecipeError, Trained
from cirl_marl.definitions.catalogue import folder
from cirl_marl.learners.algorithms import algorithms, parameter_mistakes, parameters_of
from cirl_marl.learners.checkpoint import observation_statistics
from cirl_marl.learners.interface import train
from cirl_marl.learners.policies import DifferentiablePolicy
from cirl_marl.learners.recipe import LearnerSettings, Match, Normalisation, Options, Recipe, Run, load_recipe
from docs.site.schemas import recipe_schema

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
    for network in map(cirl_marl.load_network, ONE_OF_EACH):
        recipe.check_agents(network.agents)
        assert all(recipe.learner_of(agent, network).algorithm in algorithms() for agent in network.agents)


def test_mixed_recipe_mixes() -> None:
    """Different kinds of compartments get different algorithms."""
    recipe, network = load_recipe("mixed_by_kind"), cirl_marl.load_network("copper_net")
    chosen = {agent: recipe.learner_of(agent, network).algorithm for agent in network.agents}
    assert (chosen["mine"], chosen["use"], chosen["use_to_collection"]) == ("SAC", "PPO", "TRPO")


def test_published_schema_is_up_to_date() -> None:
    """``agents/recipe.schema.json`` is what the code gives, options of the environment included."""
    published = json.loads((folder("agents") / "recipe.schema.json").read_text())
    assert published == recipe_schema()
    document: dict[str, Any] = {"name": "mine", "title": "Mine", "learner": {"algorithm": "PPO"}}
    jsonschema.validate(document | {"environment": {"reward": "mixed", "horizon": 9}}, published)
    for wrong in ({"rewrad": "mixed"}, {"reward": "mix"}, {"horizon": 0}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(document | {"environment": wrong}, published)


def test_settings_that_came_later_are_written_if_they_say_something() -> None:
    """So that cells of older sweeps keep their names; what is written is read again."""
    plain = Recipe(name="plain", title="plain", learner=LearnerSettings(algorithm="PPO")).model_dump()
    assert "epsilon" not in plain["learner"]["normalise"] and "at_most" not in plain["run"]
    assert plain["learner"]["normalise"]["clip_reward"] == 10.0
    plain["learner"]["normalise"]["epsilon"], plain["run"]["at_most"] = 0.01, {"cost": 0.0}
    assert Recipe.model_validate(plain).model_dump() == plain


@pytest.mark.parametrize("engine", ["lockstep", "stacked"])
def test_what_hardly_varies_is_magnified_by_at_most_epsilon(engine: str, tmp_path: Path) -> None:
    """The stock of a mine: 2 % less than in training is seen as 2 % less, in a kept run as well."""
    calm = Normalisation(epsilon=0.01)
    settings = LearnerSettings(algorithm="PPO", parameters={"n_steps": 8, "batch_size": 8}, normalise=calm)
    small = Recipe(name="calm", title="calm", run=Run(steps=16, envs=1, evaluations=0), learner=settings)
    trained = train("copper_net", small, agents=["mine"], horizon=9, engine=engine, directory=tmp_path / "run")
    for policy in (trained.learners["mine"].policy, Trained(tmp_path / "run").policies["mine"]):
        assert policy.normaliser is not None
        rows = np.repeat([trained.env.reset(seed=0)["mine"][0]], 2, axis=0)
        rows[1, 0] *= 0.98
        normalised = np.asarray(policy.normaliser.normalize_obs(rows))
        assert normalised[0, 0] - normalised[1, 0] == pytest.approx(0.02 / 0.1, rel=0.02)
        change = DifferentiablePolicy(policy)(torch.tensor(rows)).diff(dim=0)
        acted = np.diff(policy.model.predict(normalised, deterministic=True)[0], axis=0)
        assert change.detach().numpy() == pytest.approx(acted, abs=1e-6)


def test_exact_gradients_magnify_nothing_that_hardly_varied() -> None:
    """Set-points never vary, a mine's stock by a thousandth: 0.05 more moves no input of a policy by more than 0.5.

    Observations are in parts of scales that are declared; the floor of a deviation is a tenth of these.
    """
    recipe = load_recipe("exact_gradients")
    short = recipe.model_copy(update={"run": recipe.run.model_copy(update={"steps": 288, "episodes": 2})})
    trained, least = train("copper_net", short, horizon=9), np.inf
    for name, learner in trained.learners.items():
        assert learner.normaliser is not None
        rows = np.repeat(trained.env.reset(seed=0)[name][:1], 2, axis=0)
        rows[1] += 0.05
        normalised = np.asarray(learner.normaliser.normalize_obs(rows))
        assert np.abs(normalised[1] - normalised[0]).max() <= 0.5 + 1e-6
        least = min(least, float(np.sqrt(observation_statistics(learner.normaliser)["observation"].var).min()))
    assert least < 1e-3


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"PPO"', '"PPPO"', "learner.algorithm: unknown algorithm 'PPPO'. Did you mean 'PPO'?"),
        ("n_steps", "n_step", "unknown parameter of PPO 'n_step'. Did you mean 'n_steps'?"),
        ("[learner]", "[lerner]", "unknown key 'lerner'. Did you mean 'learner'?"),
        ("title", "titel", "unknown key 'titel'. Did you mean 'title'?"),
        ("[learner]", '[environment]\nrewrad = "local"\n[learner]', "unknown key 'rewrad'. Did you mean 'reward'?"),
        (
            "[learner]",
            '[environment]\nreward = "mix"\n[learner]',
            "environment.reward: unknown value 'mix'. Did you mean 'mixed'?",
        ),
        (
            "[learner]",
            '[environment]\nobserve = "ful"\n[learner]',
            "environment.observe: unknown value 'ful'. Did you mean 'full'?",
        ),
        (
            "[learner]",
            '[environment]\ncircularity = "ends"\n[learner]',
            "environment.circularity: unknown value 'ends'. Did you mean 'end'?",
        ),
        ("[learner]", "[environment]\ncircularity_weight = 1.5\n[learner]", "must be at most 1, got 1.5"),
        (
            "[learner]",
            "[environment]\ncircularity_weight = nan\n[learner]",
            "circularity_weight: must be a fin",
        ),
        ("[learner]", '[environment]\ncircularity_weight = "1"\n[learner]', "must be a number, got '1'"),
        (
            "[learner]",
            "[environment]\nhorizon = 2.0\n[learner]",
            "environment.horizon: must be a whole number",
        ),
        ("[learner]", "[environment]\nscenario = 1\n[learner]", "environment.scenario: must be a text"),
        ("[learner]", '[match]\nrole = "landfill"\nalgorithm = "A2C"\n[learner]', "match: write [[match]], with two b"),
        (
            "[learner]",
            '[[match]]\nalgorithm = "SAC"\n[learner]',
            "match.0: fits every agent; give kind,",
        ),
        (
            '"PPO"\nparameters = { n_steps = 8',
            '"SAC"\nparameters = { action_noise = 3',
            "needs kind and a number sigma of at least 0, got 3",
        ),
        (
            '"PPO"\nparameters = { n_steps = 8',
            '"SAC"\nparameters = { action_noise = { kind = "nrmal", sigma = 1 }',
            "unknown kind 'nrmal'. Did you mean 'normal'?",
        ),
        ("[learner]", "[run]\nsteps = 0\n[learner]", "run.steps: must be more than 0, got 0"),
        ("[learner]", '[learner]\npolicy = "MlpPolcy"', "unknown policy of PPO for vectors 'MlpPolcy'. Did you mean"),
        (
            "n_steps = 8",
            "learning_rate = { linear_from = 1e-3 }",
            "learning_rate: needs a number of at least 0, or two such, l",
        ),
        ("n_steps = 8", 'batch_size = "a"', "parameters.batch_size: PPO needs int of at least 1, got 'a'"),
        ("n_steps = 8", "n_epochs = 2.5", "parameters.n_epochs: PPO needs int of at least 1, got 2.5"),
        ("n_steps = 8", "n_steps = 0", "parameters.n_steps: PPO needs int of at least 1, got 0"),
        ("n_steps = 8", "clip_range = -0.2", "parameters.clip_range: needs a number of at least 0, or two"),
        ("n_steps = 8", "target_kl = -1", "parameters.target_kl: PPO needs float | None of at least 0, got -1"),
        (
            "n_steps = 8",
            "learning_rate = { linear_from = 1e-3, linear_to = -1e-3 }",
            "learning_rate: needs a number of at least 0, or two such",
        ),
        (
            '"PPO"\nparameters = { n_steps = 8',
            '"SAC"\nparameters = { train_freq = [0, "step"]',
            "parameters.train_freq: SAC needs int | tuple[int, str] of at least 1, got [0, 'step']",
        ),
        (
            '"PPO"\nparameters = { n_steps = 8',
            '"SAC"\nparameters = { action_noise = { kind = "normal", sigma = -0.1 }',
            "needs kind and a number sigma of at least 0",
        ),
        ("[learner]", '[run]\nsteps = "9"\n[learner]', "run.steps: must be a whole number, got '9'"),
        ("[learner]", "[run]\nenvs = true\n[learner]", "run.envs: must be a whole number, got True"),
        ("[learner]", '[learner]\nbootstrap = "no"', "learner.bootstrap: must be true or false, got 'no'"),
        ("[learner]", "[learner]\nnormalise = { clip_reward = inf }", "clip_reward: must be a finite number"),
        ("n_steps = 8", "gamma = true", "parameters.gamma: PPO needs float in [0, 1], got True"),
        ("n_steps = 8", "gamma = nan", "learner.parameters.gamma: must be a finite number, got nan"),
        ("n_steps = 8", "gamma = 1.01", "learner.parameters.gamma: PPO needs float in [0, 1], got 1.01"),
        ("n_steps = 8", "gae_lambda = -0.1", "learner.parameters.gae_lambda: PPO needs float in [0, 1], got -0.1"),
        ("n_steps = 8", "ent_coef = inf", "learner.parameters.ent_coef: must be a finite number, got inf"),
        (
            "n_steps = 8",
            'learning_rate = "a"',
            "learning_rate: needs a number of at least 0, or two such, linear_from and linear_to: 'a'",
        ),
        (
            "n_steps = 8",
            "learning_rate = { linear_from = nan, linear_to = 0 }",
            "learning_rate.linear_from: must be a f",
        ),
        (
            "n_steps = 8",
            "policy_kwargs = { optimizer_kwargs = { betas = [0.9, inf] } }",
            "learner.parameters.policy_kwargs.optimizer_kwargs.betas.1: must be a finite number, got inf",
        ),
        ("n_steps = 8", "policy_kwargs = 3", "parameters.policy_kwargs: PPO needs dict[str, Any] | None, got 3"),
        ("n_steps = 8", "max_grad_norm = -0.5", "parameters.max_grad_norm: PPO needs float of at least 0, got -0.5"),
        ("n_steps = 8", "sde_sample_freq = -5", "parameters.sde_sample_freq: PPO needs int of at least -1, got -5"),
        (
            '"PPO"\nparameters = { n_steps = 8',
            '"SAC"\nparameters = { target_update_interval = 0',
            "parameters.target_update_interval: SAC needs int of at least 1, got 0",
        ),
        (
            '"PPO"\nparameters = { n_steps = 8',
            '"ARS"\nparameters = { n_top = 9',
            "n_top: ARS has no more than 8, got 9",
        ),
        (
            '"PPO"\nparameters = { n_steps = 8',
            '"ARS"\nparameters = { n_delta = "x", n_top = 9',
            "parameters.n_delta: ARS needs int of at least 1, got 'x'",
        ),
        (
            '"PPO"\nparameters = { n_steps = 8',
            '"TQC"\nparameters = { top_quantiles_to_drop_per_net = 5, policy_kwargs = "x"',
            "parameters.policy_kwargs: TQC needs dict",
        ),
        (
            '"PPO"\nparameters = { n_steps = 8',
            '"TQC"\nparameters = { top_quantiles_to_drop_per_net = 5, policy_kwargs = { n_quantiles = 5 }',
            "parameters.top_quantiles_to_drop_per_net: TQC has no more than 4, got 5",
        ),
        (
            "n_steps = 8",
            'policy_kwargs = { activation_fn = "tanh" }',
            "policy_kwargs.activation_fn: is a class, which only Python can give, not a text, got 'tanh'",
        ),
        ("n_steps = 8", "target_kl = [1.0]", "parameters.target_kl: PPO needs float | None of at least 0, got [1.0]"),
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


def test_mistakes_of_all_kinds_are_named_together(tmp_path: Path) -> None:
    """Those that the shape of the file shows, and those of what it says, in every table; none that is not there."""
    text = GOOD.replace("title", "titel").replace("n_steps = 8", "gamma = 2.0, clip_range = nan")
    text += '[run]\nsteps = 0\n[environment]\nreward = "mix"\nhorizon = 0\n'
    text += '[[match]]\nrole = "landfill"\nalgorithm = "RecurrentPPO"\npolicy = "MlpPolcy"\n'
    text += 'demonstrations = { controller = "neutral", steps = 9 }\nparameters = { learning_rate = -inf }\n'
    with pytest.raises(DefinitionError) as raised:
        load_recipe(write(tmp_path, text))
    assert sorted(problem.partition(": ")[0] for problem in raised.value.problems) == [
        "environment.horizon",
        "environment.reward",
        "learner.parameters.clip_range",
        "learner.parameters.gamma",
        "match.0.demonstrations",
        "match.0.parameters.learning_rate",
        "match.0.policy",
        "run.steps",
        "titel",
        "title",
    ]


def test_options_are_those_of_the_environment() -> None:
    """Recipes may say what ``MultiAgentVectorEnv`` takes, in its words."""
    taken = set(inspect.signature(MultiAgentVectorEnv).parameters) - {"network", "num_envs", "agents"}
    assert set(Options.model_fields) == taken
    words = get_args(Options.model_fields["circularity"].annotation)
    with pytest.raises(CirlError, match=rf"unknown circularity 'ends'.* Known: {', '.join(words)}\."):
        MultiAgentVectorEnv("copper_net", num_envs=1, circularity="ends")


def test_mistakes_that_need_the_network_are_named(tmp_path: Path) -> None:
    """Unknown agents, and values that the algorithm refuses, are errors before anything is trained or written."""
    matches = '[[match]]\nkind = "arc"\nalgorithm = "A2C"\n[[match]]\nagents = ["mien", "ues"]\nalgorithm = "A2C"\n'
    with pytest.raises(RecipeError) as raised:
        train("copper_net", write(tmp_path, GOOD + matches), directory=tmp_path / "run")
    assert "match.1.agents: unknown agent 'mien'. Did you mean 'mine'?" in str(raised.value)
    assert "match.1.agents: unknown agent 'ues'. Did you mean 'use'?" in str(raised.value)
    for refused, said in {
        "n_steps = 1": "n_steps",
        "policy_kwargs = { optimizer_kwargs = { lrr = 1.0 } }": "lrr",
        "policy_kwargs = { net_ach = [8] }": "unexpected keyword argument 'net_ach'",
        "policy_kwargs = { use_sde = true }": "multiple values for keyword argument 'use_sde'",
    }.items():
        path = write(tmp_path, GOOD.replace("n_steps = 8", refused))
        with pytest.raises(RecipeError, match=f"agent 'refinery': PPO refuses its parameters .*{said}"):
            train("copper_net", path, envs=1, directory=tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("option", "nearest"),
    [("observ", "observe"), ("seeds", "seed"), ("step", "steps"), ("env", "envs"), ("agent", "agents")],
)
def test_options_of_training_are_matched_with_all_that_it_takes(option: str, nearest: str, ppo_recipe: Recipe) -> None:
    """Those of the environment and its own."""
    with pytest.raises(CirlError, match=rf"unknown option '{option}'\. Did you mean '{nearest}'\?") as raised:
        train("copper_net", ppo_recipe, **cast(Any, {option: 0}))
    assert all(name in str(raised.value) for name in ("scenario", "directory", "callbacks", "report"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"environment": {"rewrad": "local"}}, "unknown key 'rewrad'. Did you mean 'reward'"),
        ({"environment": {"num_envs": 3}}, "unknown key 'num_envs'"),
        (
            {"environment": {"reward": "mix"}},
            "recipe 'small': environment.reward: unknown value 'mix'. Did you mean 'mix",
        ),
        (
            {"learner": LearnerSettings(algorithm="PPO", parameters={"gamma": float("nan")})},
            "parameters.gamma: must be a fin",
        ),
        ({"match": [Match(role="landfill", algorithm="PPP")]}, "match.0.algorithm: unknown algorithm 'PPP'"),
        ({"learner": LearnerSettings(algorithm="SAC", policy="CentralCriticPolicy")}, "unknown policy of SAC"),
        (
            {
                "learner": LearnerSettings(
                    algorithm="PPO", policy="CentralCriticPolicy", normalise=Normalisation(observation=False)
                )
            },
            "sees physical units",
        ),
        ({"learner": LearnerSettings(algorithm="PPP")}, "unknown algorithm 'PPP'"),
    ],
)
def test_recipes_of_python_are_checked_like_files(changes: dict[str, Any], message: str, ppo_recipe: Recipe) -> None:
    """A recipe object with a mistake is refused by name, before anything is trained."""
    with pytest.raises(RecipeError, match=message):
        train("copper_net", ppo_recipe.model_copy(update=changes))


def test_whole_episodes_need_a_single_environment(tmp_path: Path) -> None:
    """The library learns after whole episodes in one environment only; it is said before anything is written."""
    text = GOOD.replace('"PPO"', '"SAC"').replace("n_steps = 8", 'train_freq = [1, "episode"]')
    path = write(tmp_path, text)
    with pytest.raises(RecipeError, match=r"train_freq: SAC learns after whole episodes in a single .*not in 2"):
        train("copper_net", path, envs=2, directory=tmp_path / "run")
    assert not (tmp_path / "run").exists()
    train("copper_net", path, envs=1, steps=3, agents=["mine"], horizon=2)


@pytest.mark.parametrize(
    ("layers", "place"),
    [
        ([8, -1], ".1"),
        ([0], ".0"),
        ([10**30], ".0"),
        ([True], ".0"),
        ([1.5], ".0"),
        ({"pi": [8], "vf": [8, -1]}, ".vf.1"),
        ("8", ""),
        (["8"], ".0"),
    ],
)
def test_layers_have_units(layers: Any, place: str) -> None:
    """The library leaves it to PyTorch to refuse a layer of −1 units, which is no mistake of a recipe there."""
    (mistake,) = parameter_mistakes("PPO", {"policy_kwargs": {"net_arch": layers}})
    assert mistake.startswith(f"parameters.policy_kwargs.net_arch{place}: a layer has 1 to 65,536 units, got ")
    for good in ([8, 8], {"pi": [8], "vf": [65536]}, []):
        assert list(parameter_mistakes("PPO", {"policy_kwargs": {"net_arch": good}})) == []


def test_lists_stand_for_tuples() -> None:
    """TOML has no tuples; the library takes some parameters as such."""
    assert list(parameter_mistakes("SAC", {"train_freq": [1, "episode"]})) == []
    (mistake,) = parameter_mistakes("SAC", {"train_freq": ["episode", 1]})
    assert mistake == "parameters.train_freq: SAC needs int | tuple[int, str] of at least 1, got ['episode', 1]"


def test_parameters_are_those_of_the_library() -> None:
    """Recipes may set what the constructors take, and nothing that the training or the algorithm sets itself."""
    assert {"learning_rate", "gamma", "n_steps"} <= set(parameters_of("PPO"))
    assert not {"env", "seed", "device"} & set(parameters_of("SAC"))
    assert {"PPO", "A2C", "SAC", "TD3", "DDPG", "TQC", "ARS", "TRPO"} <= set(algorithms())
    for name in algorithms():
        own = {key: parameter.default for key, parameter in parameters_of(name).items()}
        assert list(parameter_mistakes(name, own)) == []
