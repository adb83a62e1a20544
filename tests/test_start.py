"""A start from another run: the policy is that of the run, whoever only acts keeps it, and mistakes are named."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from some import some
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from cirl_marl import CirlError, DefinitionError, LearnerError, RecipeError
from cirl_marl.learners.checkpoint import observation_statistics
from cirl_marl.learners.interface import Trained, _learn_first, prepare, resume, train, train_seeds
from cirl_marl.learners.learner import Learner, load_acting_learner
from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.learners.start import _other_settings
from cirl_marl.learners.trainer import Progress, Training

AGENTS = ["mine", "use"]
OPTIONS: dict[str, Any] = {"agents": AGENTS, "horizon": 4}
PPO: dict[str, Any] = {"n_steps": 4, "batch_size": 8, "n_epochs": 1, "policy_kwargs": {"net_arch": [8]}}
BUFFER: dict[str, Any] = {"learning_starts": 4, "buffer_size": 100, "batch_size": 4, "policy_kwargs": {"net_arch": [8]}}
ALGORITHMS: dict[str, dict[str, Any]] = {
    "PPO": PPO,
    "ARS": {"n_delta": 1},
    "SAC": BUFFER,
    "TQC": BUFFER,
    "TD3": BUFFER,
    "RecurrentPPO": PPO,
}


def recipe(algorithm: str = "PPO", matches: list[dict[str, Any]] | None = None, **learner: Any) -> Recipe:
    """Return a recipe in which everybody learns by ``algorithm`` in two copies, but for ``matches``."""
    common = {"algorithm": algorithm, "parameters": ALGORITHMS[algorithm]}
    if algorithm == "RecurrentPPO":
        common["policy"] = "MlpLstmPolicy"
    told = [common | match for match in matches or []]
    return Recipe.model_validate(
        {
            "name": "a",
            "title": "a",
            "run": {"steps": 24, "envs": 2, "evaluations": 0},
            "learner": common | learner,
            "match": told,
        }
    )


def from_run(run: Path, agent: str | None = None, **others: Any) -> dict[str, Any]:
    """Return the keys of a learner that starts from ``run``."""
    return {"start": {"run": str(run), "agent": agent}, **others}


def weights(learner: Learner) -> dict[str, torch.Tensor]:
    """Return the weights of a learner, critics and a learnt entropy coefficient included."""
    found = {key: value.clone() for key, value in learner.model.policy.state_dict().items()}
    if isinstance(coefficient := getattr(learner.model, "log_ent_coef", None), torch.Tensor):
        found["log_ent_coef"] = coefficient.detach().clone()
    return found


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    """Return whether weights are bit-equal."""
    return one.keys() == other.keys() and all(torch.equal(value, other[key]) for key, value in one.items())


def statistics(learner: Learner) -> list[float]:
    """Return what a learner's normaliser knows of observations."""
    assert isinstance(learner.env, VecNormalize)
    known: Any = learner.env.obs_rms
    return [*known.mean, *known.var, known.count]


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[Training, Path]:
    """Return a run of two PPO learners, and where it is."""
    path = tmp_path_factory.mktemp("runs") / "first"
    return train("copper_net", recipe(), directory=path, **OPTIONS), path


@pytest.mark.parametrize("algorithm", list(ALGORITHMS))
@pytest.mark.sample(2)
def test_policy_before_the_first_update_is_that_of_the_run(algorithm: str, tmp_path: Path) -> None:
    """With critics, entropy coefficient and statistics of observations; optimiser, steps and rewards begin anew."""
    source = train("copper_net", recipe(algorithm), directory=tmp_path / "first", **OPTIONS)
    found = prepare("copper_net", recipe(algorithm, **from_run(tmp_path / "first")), seed=7, **OPTIONS)
    fresh = prepare("copper_net", recipe(algorithm), seed=7, **OPTIONS)
    for name in AGENTS:
        old, new = source.learners[name], found.learners[name]
        assert same(weights(new), weights(old)) and not same(weights(new), weights(fresh.learners[name]))
        assert statistics(new) == statistics(old)
        assert new.model.num_timesteps == 0
        assert isinstance(new.env, VecNormalize) and new.env.ret_rms.count < 1.0
        if algorithm == "ARS":
            vector = torch.nn.utils.parameters_to_vector(new.model.policy.parameters())
            assert torch.equal(torch.as_tensor(new.model.weights), vector)  # type: ignore[attr-defined]


def test_whoever_has_no_share_of_the_steps_only_acts(first: tuple[Training, Path], tmp_path: Path) -> None:
    """Weights are bit-equal in the end, and its actions those of the other run; the other learns on."""
    source, path = first
    acting = [{"agents": ["mine"], **from_run(path, share_of_steps=0)}]
    found = train("copper_net", recipe(matches=acting, **from_run(path)), directory=tmp_path / "run", **OPTIONS)
    mine, use = (found.learners[name] for name in AGENTS)
    assert same(weights(mine), weights(source.learners["mine"]))
    for learner in (mine, use):
        assert statistics(learner) == statistics(source.learners[learner.name])
    assert not same(weights(use), weights(source.learners["use"])) and use.model.num_timesteps == 24
    before, after = Trained(path), Trained(tmp_path / "run")
    observations = found.env.reset(seed=[1, 2])
    for each in (before, after):
        each.start(found.env, 0)
    np.testing.assert_array_equal(before.act(observations)["mine"], after.act(observations)["mine"])


def test_shared_policy_has_a_start_too(tmp_path: Path) -> None:
    """Its name is that of the learner, and None is the one of the same name."""
    shared = recipe(scheme="shared")
    source = train("copper_net", shared, directory=tmp_path / "first", **OPTIONS)
    asked = recipe(scheme="shared", **from_run(tmp_path / "first"))
    (found,) = prepare("copper_net", asked, **OPTIONS).learners.values()
    assert same(weights(found), weights(source.learners["shared-learner"]))


def test_start_is_the_best_checkpoint(tmp_path: Path) -> None:
    """Where evaluations chose one, as whoever evaluates the run sees it."""
    asked = recipe()
    chosen = asked.model_copy(update={"run": asked.run.model_copy(update={"evaluations": 6, "episodes": 2})})
    train("copper_net", chosen, directory=tmp_path / "first", **OPTIONS)
    found = prepare("copper_net", recipe(**from_run(tmp_path / "first")), **OPTIONS)
    folder = RunDirectory(tmp_path / "first").acting_checkpoint
    assert folder.name.endswith("-best") and found.config.origins["use"].checkpoint == folder.name
    source = RunDirectory(tmp_path / "first")
    group = next(each for each in source.groups() if each.name == "use")
    expected = load_acting_learner(folder, group, source.make_env(1)).model.policy.state_dict()
    assert same(weights(found.learners["use"]), expected)


def test_learners_that_imitate_are_not_stacked() -> None:
    """They run in lockstep with the others, and whoever asks for a stack is told why there is none."""
    asked = recipe(demonstrations={"controller": "neutral", "steps": 8})
    why = "demonstrations: each learner imitates by itself"
    with pytest.raises(RecipeError, match=f"agent 'mine': engine stacked: {why}; use engine auto or lockstep"):
        train("copper_net", asked, engine="stacked", **OPTIONS)
    assert train("copper_net", asked, **OPTIONS).joint_steps == 12


def test_a_stack_of_starts_learns_what_lockstep_does(first: tuple[Training, Path]) -> None:
    """Statistics of observations stay as they were in both."""
    asked = recipe(**from_run(first[1]))
    lone, together = (train("copper_net", asked, engine=engine, **OPTIONS) for engine in ("lockstep", "stacked"))
    for name, learner in together.learners.items():
        for key, value in weights(lone.learners[name]).items():
            torch.testing.assert_close(weights(learner)[key], value, rtol=1e-5, atol=1e-6)
        assert statistics(learner) == statistics(first[0].learners[name])


def test_the_last_layer_alone_goes_on_learning(tmp_path: Path) -> None:
    """Of a stacked search; whatever cannot do so says why."""
    small: dict[str, Any] = {"parameters": {"n_delta": 1, "n_eval_episodes": 1, "policy_kwargs": {"net_arch": [4, 3]}}}
    train("copper_net", recipe("ARS", **small), directory=tmp_path / "first", **OPTIONS)
    begun = train("copper_net", recipe("ARS", **small), **OPTIONS)
    start: dict[str, Any] = {"start": {"run": str(tmp_path / "first"), "last_layer": True}}
    found = train("copper_net", recipe("ARS", **small, **start), **OPTIONS)
    for name, learner in found.learners.items():
        before, after = weights(begun.learners[name]), weights(learner)
        moved = {key for key in before if not torch.equal(before[key], after[key])}
        assert moved == {"action_net.4.weight", "action_net.4.bias"}
    with pytest.raises(RecipeError, match=r"start.last_layer: needs a stacked ARS, which engine lockstep prevents"):
        train("copper_net", recipe("ARS", **small, **start), engine="lockstep", **OPTIONS)
    with pytest.raises(RecipeError, match=r"start.last_layer: is for ARS, not for PPO"):
        train("copper_net", recipe("PPO", **start), **OPTIONS)


class FailsAtOnce(BaseCallback):
    """Fails at the first step of its learner."""

    def _on_step(self) -> bool:
        raise ValueError("no more")


def test_run_goes_on_without_the_one_it_started_from(first: tuple[Training, Path], tmp_path: Path) -> None:
    """From the first moment on: the policies are saved before the first step, and where they came from is on record."""
    source, path = tmp_path / "first", first[1]
    shutil.copytree(path, source)
    run = RunDirectory(tmp_path / "run")
    acting = [{"agents": ["mine"], **from_run(source, "mine", share_of_steps=0)}]
    with pytest.raises(LearnerError):
        train(
            "copper_net",
            recipe(matches=acting, **from_run(source)),
            directory=run.path,
            callbacks={"use": FailsAtOnce()},
            steps=80,
            **OPTIONS,
        )
    assert run.status["checkpoint"] == "000000000-start"
    origin = run.config.origins["mine"]
    assert (origin.run, origin.agent, origin.checkpoint) == (str(source), "mine", "000000012-complete")
    assert set(origin.sha256) == {"mine.json", "mine.safetensors"} and set(run.config.origins) == set(AGENTS)
    shutil.rmtree(source)
    found = resume(run.path)
    assert run.status["state"] == "complete" and run.config.origins["mine"] == origin
    assert same(weights(found.learners["mine"]), weights(first[0].learners["mine"]))
    assert resume(run.path, steps=88).joint_steps == 44


def test_same_seed_gives_the_same_bits(first: tuple[Training, Path]) -> None:
    """With a start as without."""
    one, other = (train("copper_net", recipe(**from_run(first[1])), seed=3, **OPTIONS) for _ in range(2))
    assert all(same(weights(one.learners[name]), weights(other.learners[name])) for name in AGENTS)


def spoilt(path: Path, spoil: Callable[[Path], object]) -> None:
    """Spoil what the newest checkpoint of a run holds of the mine."""
    (folder,) = (path / "checkpoints").iterdir()
    spoil(folder)


def cut(path: Path) -> None:
    """Leave half of a file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def nothing_saved(path: Path) -> None:
    """Say that nothing was saved yet."""
    status = {"state": "running", "joint_steps": 0, "checkpoint": None, "reason": ""}
    (path / "status.json").write_text(json.dumps(status))


MISTAKES: list[tuple[Callable[[Path], object], str | None, dict[str, Any], str]] = [
    (lambda p: p.rename(p.with_name("frist")), None, {}, "unknown run '{run}'. Did you mean '{parent}/frist'?"),
    (lambda p: shutil.rmtree(p), None, {}, "no run in {run} (it has no config.json)"),
    (lambda p: (p / "config.json").write_text("{"), None, {}, "{run}/config.json: cannot be read"),
    (lambda p: (p / "status.json").unlink(), None, {}, "{run}/status.json: missing; the run directory is incomplete"),
    (nothing_saved, None, {}, "{run}: nothing was saved in this run yet (state: running)"),
    (lambda p: spoilt(p, lambda c: (c / "mine.json").unlink()), None, {}, "the checkpoint lacks the policies of mine"),
    (lambda p: spoilt(p, lambda c: cut(c / "mine.json")), None, {}, "/mine.json: cannot be read"),
    (lambda p: spoilt(p, lambda c: (c / "mine.safetensors").unlink()), None, {}, "mine.safetensors: cannot be"),
    (lambda p: None, "mnie", {}, "{run}: unknown agent 'mnie'. Did you mean 'mine'? Known: mine, use."),
    (lambda p: None, "use", {}, "'use' sees other things, 7 entries there and 4 here: only there 'stock "),
    (lambda p: None, None, {"observe": "full"}, "{run}: 'mine' sees other things, "),
    (lambda p: None, None, {"algorithm": "A2C", "parameters": {}}, "'mine' has algorithm = 'PPO', not 'A2C'"),
    (
        lambda p: None,
        None,
        {"parameters": PPO | {"policy_kwargs": {"net_arch": [9]}}},
        "there and (9, 4) here; write policy_kwargs as there",
    ),
    (
        lambda p: None,
        None,
        {"normalise": {"observation": False}},
        "'mine' has normalise.observation = true, not false",
    ),
    (lambda p: None, None, {"normalise": {"epsilon": 0.01}}, "'mine' has normalise.epsilon = 1e-08, not 0.01"),
]


@pytest.mark.parametrize(("spoil", "agent", "others", "message"), MISTAKES)
def test_starts_that_do_not_fit_are_named(
    spoil: Callable[[Path], object],
    agent: str | None,
    others: dict[str, Any],
    message: str,
    first: tuple[Training, Path],
    tmp_path: Path,
) -> None:
    """Before anything is written, and the other run is left as it is."""
    source = tmp_path / "runs" / "first"
    shutil.copytree(first[1], source)
    spoil(source)
    before = some({path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")})
    told = {key: value for key, value in others.items() if key != "observe"}
    asked = recipe(matches=[{"agents": ["mine"], **from_run(source, agent), **told}])
    with pytest.raises(RecipeError) as raised:
        train("copper_net", asked, directory=tmp_path / "run", observe=others.get("observe"), **OPTIONS)
    assert str(raised.value).startswith("agent 'mine': start: ")
    assert message.format(run=source, parent=source.parent) in str(raised.value)
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}


def test_normalisers_of_runs_that_did_not_normalise_may_differ() -> None:
    """Where observations are not normalised neither ε nor their limits count; where they are both do."""
    for observation, count in ((False, 0), (True, 2)):
        settings = [
            recipe(normalise={"observation": observation, "epsilon": epsilon, "clip_observation": clip}).learner
            for epsilon, clip in ((1e-8, 10.0), (1e-3, 5.0))
        ]
        assert len([*_other_settings(*settings)]) == count


def test_one_recipe_serves_several_seeds(first: tuple[Training, Path], tmp_path: Path) -> None:
    """In the name of the run ``{seed}`` is that of the training."""
    shutil.copytree(first[1], tmp_path / "first-seed3")
    asked = recipe(**from_run(tmp_path / "first-seed{seed}"))
    assert same(
        weights(prepare("copper_net", asked, seed=3, **OPTIONS).learners["use"]), weights(first[0].learners["use"])
    )
    with pytest.raises(RecipeError, match=r"unknown run '.*first-seed4'. Did you mean '.*first-seed3'\?"):
        prepare("copper_net", asked, seed=4, **OPTIONS)


@pytest.fixture
def recipe_first(tmp_path: Path) -> Path:
    """Return a recipe of exact gradients for one that begins with it."""
    path = tmp_path / "guess.toml"
    path.write_text(
        "name = 'guess'\ntitle = 'a first guess'\n[run]\nengine = 'gradients'\nsteps = 24\nenvs = 2\nevaluations = 3\n"
        "episodes = 2\n[environment]\nreward = 'team'\ncircularity = 'mean'\n[learner]\nalgorithm = 'PPO'\n"
        "parameters = { learning_rate = 0.1, policy_kwargs = { net_arch = [8] } }\n"
    )
    return path


def after(path: Path, **others: Any) -> Recipe:
    """Return a recipe with critics of the whole network, small noise, and a first guess by the recipe of a file."""
    exploring = PPO | {"policy_kwargs": {"net_arch": [8], "log_std_init": -1.5}}
    central = {"policy": "CentralCriticPolicy", "parameters": exploring} | others
    return recipe(start={"recipe": str(path)}, **central)


def test_what_acts_is_that_of_a_recipe_that_learnt_first(recipe_first: Path, tmp_path: Path) -> None:
    """The best it found, to the bit, with statistics of observations; critics and exploration are those of now."""
    train("copper_net", str(recipe_first), seed=7, directory=tmp_path / "first", **OPTIONS)
    source = RunDirectory(tmp_path / "first")
    groups = {group.name: group for group in source.groups()}
    found, fresh = (prepare("copper_net", after(recipe_first), seed=7, **OPTIONS) for _ in range(2))
    _learn_first([found], None, "cpu")
    for name in AGENTS:
        acted = load_acting_learner(source.acting_checkpoint, groups[name], source.make_env(1))
        old, new, plain = map(weights, (acted, found.learners[name], fresh.learners[name]))
        acting = {key for key in new if "policy_net" in key or key.startswith("action_net")}
        assert len(acting) == 4 and all(torch.equal(new[key], old[key]) for key in acting)
        assert all(torch.equal(new[key], plain[key]) for key in new.keys() - acting)
        assert not any(torch.equal(new[key], plain[key]) for key in acting)
        before, now = (observation_statistics(each.env)["observation"] for each in (acted, found.learners[name]))  # type: ignore[arg-type]
        np.testing.assert_array_equal([before.mean, before.var], [now.mean, now.var])
        origin = found.config.origins[name]
        assert (origin.run, origin.agent) == (str(recipe_first), name)


def test_each_learner_has_the_recipe_and_the_steps_that_it_names(recipe_first: Path) -> None:
    """Learners of the same recipe and steps have what was learnt together."""
    guess, longer = ({"recipe": str(recipe_first), "steps": steps} for steps in (None, 48))
    both = prepare("copper_net", recipe(matches=[{"agents": ["mine"], "start": longer}], start=guess), **OPTIONS)
    lone = [prepare("copper_net", recipe(start=start), **OPTIONS) for start in (guess, longer)]
    for training in (both, *lone):
        _learn_first([training], None, "cpu")
    usual, late = lone
    assert same(weights(both.learners["mine"]), weights(late.learners["mine"]))
    assert same(weights(both.learners["use"]), weights(usual.learners["use"]))
    assert not same(weights(late.learners["use"]), weights(usual.learners["use"]))


def test_progress_counts_what_learns_first(recipe_first: Path) -> None:
    """Of all that is to be done, for each of two seeds 24 steps, and 24 of both after them."""
    reports: list[Progress] = []
    train_seeds("copper_net", after(recipe_first), seeds=(0, 1), report=reports.append, **OPTIONS)
    steps, seconds = ([getattr(now, name) for now in reports] for name in ("env_steps", "seconds"))
    assert steps == [*range(2, 74, 2)] and {now.total for now in reports} == {72}
    assert seconds == sorted(seconds)


@pytest.mark.parametrize("engine", ["lockstep", "stacked"])
def test_critics_learn_what_the_state_is_like_after_a_recipe(recipe_first: Path, engine: str) -> None:
    """Statistics of what agents see stay, those of the state follow; both engines learn the same."""
    first = prepare("copper_net", after(recipe_first), **OPTIONS)
    _learn_first([first], None, "cpu")
    found = train("copper_net", after(recipe_first), engine=engine, **OPTIONS)
    lone = train("copper_net", after(recipe_first), engine="lockstep", **OPTIONS)
    for name in AGENTS:
        parts = [observation_statistics(each.learners[name].env) for each in (first, found)]  # type: ignore[arg-type]
        np.testing.assert_array_equal(parts[0]["observation"].mean, parts[1]["observation"].mean)
        assert parts[1]["state"].count > 24 > parts[0]["state"].count
        for key, value in weights(lone.learners[name]).items():
            torch.testing.assert_close(weights(found.learners[name])[key], value, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("engine", ["lockstep", "stacked"])
def test_critics_of_a_run_keep_what_they_know_of_the_state(tmp_path: Path, engine: str) -> None:
    """They come with the policy, and so do the statistics by which they see."""
    central: dict[str, Any] = {"policy": "CentralCriticPolicy"}
    source = train("copper_net", recipe(**central), directory=tmp_path / "first", **OPTIONS)
    found = train("copper_net", recipe(**central, **from_run(tmp_path / "first")), engine=engine, **OPTIONS)
    for name in AGENTS:
        before, now = (observation_statistics(each.learners[name].env)["state"] for each in (source, found))  # type: ignore[arg-type]
        np.testing.assert_array_equal([before.mean, before.var], [now.mean, now.var])


def test_run_after_a_recipe_goes_on_to_the_same_bits(recipe_first: Path, tmp_path: Path) -> None:
    """From the first moment on, without the recipe's file; critics' statistics go on following."""
    asked = after(recipe_first)
    whole = train("copper_net", asked, directory=tmp_path / "whole", engine="lockstep", **OPTIONS)
    run = RunDirectory(tmp_path / "run")
    callbacks: dict[str, BaseCallback] = {"use": FailsAtOnce()}
    with pytest.raises(LearnerError):
        train("copper_net", asked, directory=run.path, engine="lockstep", callbacks=callbacks, **OPTIONS)
    recipe_first.unlink()
    found = resume(run.path)
    assert all(same(weights(found.learners[name]), weights(whole.learners[name])) for name in AGENTS)
    assert run.config.origins == whole.config.origins
    states = [observation_statistics(each.learners["use"].env)["state"] for each in (found, whole)]  # type: ignore[arg-type]
    np.testing.assert_array_equal(states[0].mean, states[1].mean)


def test_a_run_that_kept_nothing_has_its_recipe_learn_again(recipe_first: Path, tmp_path: Path) -> None:
    """It does not begin without the first guess."""
    asked, run = after(recipe_first), RunDirectory(tmp_path / "run")
    whole = train("copper_net", asked, directory=run.path, **OPTIONS)
    shutil.rmtree(run.path / "checkpoints")
    nothing_saved(run.path)
    found = resume(run.path)
    assert all(same(weights(found.learners[name]), weights(whole.learners[name])) for name in AGENTS)


def test_recipes_that_cannot_learn_first_are_named(recipe_first: Path, tmp_path: Path) -> None:
    """Those that begin with a recipe themselves, those of other policies, and those that see something else."""
    text, start = recipe_first.read_text(), {"recipe": str(recipe_first)}
    loop = tmp_path / "loop.toml"
    loop.write_text(text.replace("[learner]", f"[learner]\nstart = {{ recipe = '{loop}' }}"))
    with pytest.raises(DefinitionError, match=r"'guess' begins with a recipe itself; name one that begins"):
        load_recipe(loop)
    other = Recipe.model_validate(recipe().model_dump() | {"learner": {"algorithm": "A2C", "start": start}})
    with pytest.raises(RecipeError, match=r"agent 'mine': start: .* has algorithm = 'PPO', not 'A2C'"):
        train("copper_net", other, directory=tmp_path / "run", **OPTIONS)
    narrow = PPO | {"policy_kwargs": {"net_arch": [9]}}
    with pytest.raises(RecipeError, match=r"there and \(9, 4\) here; write policy_kwargs as there"):
        train("copper_net", after(recipe_first, parameters=narrow), directory=tmp_path / "run", **OPTIONS)
    assert not (tmp_path / "run").exists()
    recipe_first.write_text(text.replace("reward = 'team'", "reward = 'team'\nobserve = 'full'"))
    with pytest.raises(RecipeError, match=r"agent 'mine': start: .*: 'mine' sees other things"):
        train("copper_net", after(recipe_first), **OPTIONS)
    assert train("copper_net", after(recipe_first), observe="full", **OPTIONS).joint_steps == 12


def test_somebody_has_to_learn(first: tuple[Training, Path]) -> None:
    """If all only act, nothing is left of a training."""
    with pytest.raises(RecipeError, match=r"nobody learns: share_of_steps is 0 for all of \['mine', 'use'\]"):
        train("copper_net", recipe(**from_run(first[1], share_of_steps=0)), **OPTIONS)


GOOD = """
name = "mine"
title = "a recipe"
[learner]
algorithm = "PPO"
share_of_steps = 0
start = { run = "runs/first", agent = "mine" }
"""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"runs/first"', "3", "learner.start.run: must be a text, got 3"),
        ('"runs/first"', '""', "learner.start.run: String should have at least 1 character, got ''"),
        (
            "run =",
            "runn =",
            "learner.start.runn: unknown key 'runn'. Did you mean 'run'? Known: run, agent, last_layer, recipe, steps.",
        ),
        ('{ run = "runs/first", agent = "mine" }', '"runs/first"', "learner.start: must be a table { run = … }, got"),
        ("share_of_steps = 0", "share_of_steps = -0.1", "share_of_steps: must be at least 0"),
        ("run =", "steps = 9, run =", "start.steps: are those of a recipe that learns first; a run has its steps"),
        ('run = "runs/first", ', "", "learner.start: needs either a run or a recipe that learns first"),
        ('"runs/first"', '"runs/first", recipe = "mappo"', "learner.start: needs either a run or a recipe that learns"),
        ('run = "runs/first"', 'recipe = "mapo"', "start.recipe: unknown recipe 'mapo'. Did you mean 'mappo'?"),
        ("start =", "# start =", "learner.share_of_steps: 0, so that it never learns: give a start by which it acts"),
    ],
)
def test_mistakes_in_the_file_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    """Each is an error that names file, key, value and what would do."""
    path = tmp_path / "recipe.toml"
    path.write_text(GOOD)
    assert load_recipe(path).learner.start is not None
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(DefinitionError) as raised:
        load_recipe(path)
    assert isinstance(raised.value, CirlError) and str(path) in str(raised.value)
    assert message in str(raised.value)


def test_what_a_run_begins_with_acts_if_nothing_better_comes(first: tuple[Training, Path], tmp_path: Path) -> None:
    """It is evaluated before the first step, at prices that stay; whoever begins with nothing is evaluated later."""
    idle = PPO | {"learning_rate": 0.0}
    asked = recipe(**from_run(first[1], parameters=idle))
    settings = {"evaluations": 3, "episodes": 4, "min_service": 0.99, "price_rate": 0.5}
    asked = asked.model_copy(
        update={"run": asked.run.model_copy(update=settings), "environment": {"reward": "team", "circularity": "mean"}}
    )
    found = train("copper_net", asked, directory=tmp_path / "run", **OPTIONS)
    run = RunDirectory(tmp_path / "run")
    assert run.acting_checkpoint.name == "000000000-best"
    rows = (run.path / "evaluations.csv").read_text().splitlines()[1:]
    assert [int(row.split(",")[0]) for row in rows] == [0, 4, 8, 12]
    weights_of_circularity = [row.split(",")[-2] for row in rows]
    assert weights_of_circularity[0] == weights_of_circularity[1] != weights_of_circularity[2]
    env = found.env
    observations = env.reset(seed=[1, 2])
    before, after_run = Trained(first[1]), Trained(run)
    for each in (before, after_run):
        each.start(env, 0)
    for agent, action in before.act(observations).items():
        np.testing.assert_array_equal(action, after_run.act(observations)[agent])
    plain = asked.model_copy(update={"learner": asked.learner.model_copy(update={"start": None})})
    train("copper_net", plain, directory=tmp_path / "plain", **OPTIONS)
    rows = (tmp_path / "plain" / "evaluations.csv").read_text().splitlines()[1:]
    assert [int(row.split(",")[0]) for row in rows] == [4, 8, 12]
