"""The interface: begin a training or resume one, have its policies as a controller, export them.

What a user names becomes a recipe, an environment, learners and a run directory; the trainer does the rest.
"""

from __future__ import annotations

import inspect
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from cirl_marl.controllers.basic import Arrays
from cirl_marl.definitions.catalogue import load_network
from cirl_marl.definitions.reader import write_network
from cirl_marl.dynamics.adjoint import derivative_obstacle
from cirl_marl.environments.observations import ObservationLayout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, RecipeError, RunError, real_number, unknown_name, whole_number
from cirl_marl.learners.agent_env import AgentVecEnv
from cirl_marl.learners.algorithms import has_replay_buffer
from cirl_marl.learners.learner import Learner, load_acting_learner
from cirl_marl.learners.lockstep import global_streams_claimed
from cirl_marl.learners.policies import Policies
from cirl_marl.learners.recipe import ENGINES, OPTIONS, Recipe, load_recipe
from cirl_marl.learners.run_directory import RunConfig, RunDirectory
from cirl_marl.learners.stacked.conditions import check_device
from cirl_marl.learners.trainer import Progress, Training, TrainingReport, run_together
from cirl_marl.network import Network
from cirl_marl.records.files import publish_folder


def default_recipe(network: Network) -> str:
    """Return the name of the recipe by which a network learns if none is given.

    It is ``exact_gradients`` where the simulator has derivatives, else ``independent_ars``; both have independent
    learners who see what is local.
    """
    return "independent_ars" if derivative_obstacle(network) else "exact_gradients"


def train(
    network: str | Path | Network,
    recipe: str | Path | Recipe | None = None,
    *,
    directory: str | Path | None = None,
    steps: int | None = None,
    envs: int | None = None,
    engine: str | None = None,
    min_service: float | None = None,
    seed: int = 0,
    agents: Sequence[str] | None = None,
    callbacks: Mapping[str, BaseCallback] | None = None,
    report: TrainingReport | None = None,
    device: str = "cpu",
    checkpoint_every: float | None = None,
    **options: Any,
) -> Training:
    """Train the learners of all agents, all at once, in the same coupled environment.

    The same arguments give bit-identical policies.

    Args:
        network: catalogue name, definition file, or network.
        recipe: catalogue name, recipe file, or recipe; None takes that of ``default_recipe``.
        directory: where the run is kept; None keeps it in memory only.
        steps: environment steps, summed over the copies; None takes the recipe's.
        envs: copies of the environment; None takes the recipe's.
        engine: ``auto``, ``lockstep`` or ``stacked``; None takes the recipe's.
        min_service: level of every service that the best checkpoint must assure; None takes the recipe's.
        seed: from which every random stream derives.
        agents: who acts and learns; None takes the network's choice.
        callbacks: Stable-Baselines3 callbacks by name of the learner; learners that have one run in lockstep.
        report: called after every joint step.
        device: where stacked learners compute, as torch names it.
        checkpoint_every: seconds after which a checkpoint is written; None is a minute, 0 never.
        **options: ``scenario``, ``reward``, ``observe``, ``countdown``, ``circularity``, ``circularity_weight``,
            ``horizon``, ``uncertain``; they override the recipe's.

    Returns:
        The finished training; ``learners[name].model`` is the Stable-Baselines3 model.

    Raises:
        CirlError: for input that cannot be used, before anything is written.
        LearnerError: if a learner fails; the last checkpoint stays.
        KeyboardInterrupt: after Ctrl-C, SIGTERM or SIGHUP; the run is saved first and can be resumed.
    """
    _check_options(options, train)
    options |= {"steps": steps, "envs": envs, "engine": engine, "min_service": min_service, "agents": agents}
    options |= {"callbacks": callbacks, "report": report, "device": device, "checkpoint_every": checkpoint_every}
    (training,) = _train(network, recipe, [(seed, directory)], **options)
    return training


def train_seeds(
    network: str | Path | Network,
    recipe: str | Path | Recipe | None = None,
    *,
    seeds: Sequence[int],
    directory: str | Path | None = None,
    report: TrainingReport | None = None,
    device: str = "cpu",
    **options: Any,
) -> list[Training]:
    """Train once for each of ``seeds``, all step by step together, so that learners of all runs stack.

    What is learnt does not depend on who learns beside it. Runs are kept in ``directory-seedN``; the other arguments
    are those of ``train``.
    """
    _check_options(options, train, train_seeds)
    runs = [(seed, None if directory is None else f"{directory}-seed{seed}") for seed in seeds]
    return _train(network, recipe, runs, report=report, device=device, **options)


def _train(
    network: str | Path | Network,
    recipe: str | Path | Recipe | None,
    runs: Sequence[tuple[int, str | Path | None]],
    *,
    callbacks: Mapping[str, BaseCallback] | None = None,
    report: TrainingReport | None = None,
    device: str,
    **options: Any,
) -> list[Training]:
    check_device(device)
    with ExitStack() as claims:
        claims.enter_context(global_streams_claimed())
        trainings = [prepare(network, recipe, seed=seed, **options) for seed, _ in runs]
        for training in trainings:
            training.check_callbacks(callbacks or {})
            training.stackable(callbacks or {})
        report = _learn_first(trainings, report, device)
        for (_, directory), training in zip(runs, trainings, strict=True):
            if directory is not None:
                run = claims.enter_context(create_run(Path(directory), training.config, training.env.network))
                training.keep_in(run)
        run_together(trainings, callbacks=callbacks, report=report, device=device)
    return trainings


def _learn_first(trainings: Sequence[Training], report: TrainingReport | None, device: str) -> TrainingReport | None:
    """Train what learners begin with, and give them what acts there; return what reports the trainings themselves.

    All are reported as parts of one.
    """
    stages = [(training, *stage) for training in trainings for stage in _first_trainings(training)]
    began, done = time.perf_counter(), 0
    total = sum(first.config.steps for _, _, first in stages) + trainings[0].config.steps

    def part(steps: int) -> TrainingReport | None:
        return None if report is None else partial(_report_part, report, began, done, total - steps)

    for training, names, first in stages:
        with (
            tempfile.TemporaryDirectory() as folder,
            create_run(Path(folder) / "run", first.config, first.env.network) as run,
        ):
            first.keep_in(run)
            run_together([first], report=part(first.config.steps), device=device)
            training.begin_from(dict.fromkeys(names, run.path))
        done += first.config.steps
    return part(trainings[0].config.steps)


def _first_trainings(training: Training) -> Iterator[tuple[list[str], Training]]:
    """Yield each recipe with which learners begin, to be trained in the same network and with the same seed."""
    env, config = training.env, training.config
    recipes = {name: (start.recipe, start.steps) for name, start in training.starts.items() if start.recipe}
    options = {
        key: config.options[key] for key in ("observe", "countdown", "horizon", "uncertain") if key in config.options
    }
    for recipe, steps in dict.fromkeys(recipes.values()):
        names = [name for name, key in recipes.items() if key == (recipe, steps)]
        yield names, prepare(env.network, recipe, steps=steps, seed=config.seed, agents=env.agents, **options)


def _report_part(report: TrainingReport, began: float, done: int, remainder: int, now: Progress) -> None:
    seconds = time.perf_counter() - began
    report(replace(now, env_steps=done + now.env_steps, total=remainder + now.total, seconds=seconds))


def prepare(
    network: str | Path | Network,
    recipe: str | Path | Recipe | None,
    *,
    steps: int | None = None,
    envs: int | None = None,
    engine: str | None = None,
    min_service: float | None = None,
    seed: int = 0,
    agents: Sequence[str] | None = None,
    checkpoint_every: float | None = None,
    **options: Any,
) -> Training:
    """Return the training that ``train`` would start with these arguments; nothing is trained and nothing written."""
    if recipe is None:
        network = load_network(network)
        recipe = default_recipe(network.scenario(options.get("scenario")))
    full_recipe = recipe if isinstance(recipe, Recipe) else load_recipe(recipe)
    steps = full_recipe.run.steps if steps is None else whole_number("steps", steps, 1)
    if engine is not None and engine not in ENGINES:
        raise CirlError(unknown_name("engine", engine, ENGINES))
    run_options: dict[str, Any] = {} if engine is None else {"engine": engine}
    run_options |= {} if min_service is None else {"min_service": real_number("min_service", min_service, 0, 1)}
    full_recipe = full_recipe.model_copy(update={"run": full_recipe.run.model_copy(update=run_options)})
    full_recipe.check(steps)
    overrides = {n: v.item() if isinstance(v, np.generic) else v for n, v in options.items() if v is not None}
    settings = full_recipe.environment | overrides
    copies = full_recipe.run.envs if envs is None else whole_number("envs", envs, 1)
    env = MultiAgentVectorEnv(network, num_envs=copies, agents=agents, **settings)
    if not env.agents:
        raise CirlError(f"network '{env.network.name}': no compartment has a control, so nothing can learn")
    full_recipe.check_agents(env.agents)
    full_recipe.check_copies(copies)
    settings.pop("scenario", None)
    task: dict[str, Any] = {"network": env.network.name, "scenario": env.network.scenario_name, "agents": env.agents}
    task |= {"recipe": full_recipe, "seed": whole_number("seed", seed, 0), "steps": steps, "envs": copies}
    config = RunConfig(**task, options=settings)
    training = Training(config, env, checkpoint_every=_seconds(checkpoint_every))
    if not any(learner.spec.share_of_steps for learner in training.learners.values()):
        raise RecipeError(
            f"recipe '{full_recipe.name}': nobody learns: share_of_steps is 0 for all of {list(env.agents)}"
        )
    return training


def resume(
    directory: str | Path,
    *,
    steps: int | None = None,
    callbacks: Mapping[str, BaseCallback] | None = None,
    report: TrainingReport | None = None,
    device: str = "cpu",
    checkpoint_every: float | None = None,
) -> Training:
    """Go on with an interrupted run from its last checkpoint, or with a complete one to more steps than it has.

    An interrupted run ends with the same bits as if it had not been interrupted, as long as ``steps`` are the same:
    from where it was saved, or from its beginning if it was not. A complete one begins fresh episodes and random
    streams. Schedules of learning rates go on as if the run had been meant to have ``steps`` from the beginning.

    Args:
        directory: the run.
        steps: environment steps of the whole run, summed over the copies; None takes what was first asked for.
        callbacks: Stable-Baselines3 callbacks by name of the learner; a run does not keep those that it began with.
        report: called after every joint step.
        device: where stacked learners compute, as torch names it.
        checkpoint_every: seconds after which a checkpoint is written; None is a minute, 0 never.

    Raises:
        CirlError: if the run has ``steps`` behind it.
        RunError: if nothing is left to do, if a complete run no longer has the replay buffers that it needs, if it is
            being trained, or if its directory is not whole.
    """
    check_device(device)
    run, checkpoint_every = RunDirectory(directory), _seconds(checkpoint_every)
    config = run.config
    with global_streams_claimed(), run.lock():
        config = _config_to_go_on(run, config, steps)
        if version_changes := run.other_versions():
            warnings.warn(f"{run.path}: other versions may give other bits: {'; '.join(version_changes)}", stacklevel=2)
        training, checkpoint = _from_newest_checkpoint(run, config, checkpoint_every)
        if checkpoint is None:
            report = _learn_first([training], report, device)
        training.check_callbacks(callbacks or {})
        run.reopen(config, checkpoint)
        training.keep_in(run)
        run_together([training], callbacks=callbacks, report=report, device=device)
    return training


def _seconds(checkpoint_every: float | None) -> float | None:
    return None if checkpoint_every is None else real_number("checkpoint_every", checkpoint_every, 0)


def _from_newest_checkpoint(
    run: RunDirectory, config: RunConfig, checkpoint_every: float | None
) -> tuple[Training, Path | None]:
    """Return the training from the newest checkpoint that is whole, and this; one that is damaged is named."""
    errors: list[RunError] = []
    for checkpoint in run.resumable():
        try:
            training = Training(config, run.make_env(config.envs), checkpoint, checkpoint_every)
        except Exception as error:  # whatever comes of a damaged file
            named = f"{checkpoint}: training cannot go on from it: {error!r}"
            errors.append(error if isinstance(error, RunError) else RunError(named))
            continue
        for problem in errors:
            warnings.warn(f"{problem}; going on from {checkpoint.name} instead", stacklevel=3)
        return training, checkpoint
    if errors:
        raise errors[0]
    return Training(config, run.make_env(config.envs), None, checkpoint_every), None


def _config_to_go_on(run: RunDirectory, config: RunConfig, steps: int | None) -> RunConfig:
    status = run.status
    done, complete = status["joint_steps"] * config.envs, status["state"] == "complete"
    if steps is not None:
        config = config.model_copy(update={"steps": whole_number("steps", steps, done + 1)})
        config.recipe.check(config.steps)
    elif complete:
        raise RunError(f"{run.path}: the run is complete ({done:,} environment steps); give more steps to go on")
    if complete:
        off_policy = [group.name for group in run.groups() if has_replay_buffer(group.spec.algorithm)]
        if off_policy:
            raise RunError(f"{run.path}: complete runs keep no replay buffers, without which {off_policy} cannot go on")
    return config


@contextmanager
def create_run(directory: Path, config: RunConfig, network: Network) -> Iterator[RunDirectory]:
    """Start a locked run directory; the definition is copied if it is still what was trained on, else written."""
    groups = {"horizon": ("episode", network.episode), "circularity_weight": ("objective", network.objective)}
    changes = {group: {name: getattr(now, name)} for name, (group, now) in groups.items() if name in config.options}
    source = network.source
    if source is not None and source.is_file():
        read = load_network(network.address, scenario=network.scenario_name).with_options(**changes)
        if read == network:
            data = {**load_network(network.address).data_sha256, **read.data_sha256}  # it is read by its default
            config = config.model_copy(update={"region": read.region, "data_sha256": data})
            with RunDirectory.create(directory, config, source) as run:
                yield run
            return
    with ExitStack() as claims:
        with tempfile.TemporaryDirectory() as folder:
            definition = Path(folder) / "network.toml"
            write_network(network, definition)
            try:
                load_network(definition)
            except CirlError as error:
                raise RunError(f"{directory}: a run on disk needs a network that can be read again: {error}") from error
            config = config.model_copy(update={"scenario": "default"})
            run = claims.enter_context(RunDirectory.create(directory, config, definition))
        yield run


def _check_options(options: Iterable[str], *functions: Callable[..., object]) -> None:
    """Refuse options that are neither the environment's nor keywords of these functions."""
    parameters = [parameter for function in functions for parameter in inspect.signature(function).parameters.values()]
    keywords = (parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY)
    names = dict.fromkeys((*OPTIONS, *keywords))
    for option in options:
        if option not in names:
            raise CirlError(unknown_name("option", option, names))


def complete_run(
    directory: Path,
    network: str | Path | Network,
    recipe: Recipe,
    *,
    report: TrainingReport | None = None,
    checkpoint_every: float | None = None,
    **options: Any,
) -> RunDirectory:
    """Return the complete run of a directory: trained from the beginning, from its last checkpoint, or not at all.

    A run that is there is taken for the right one. The arguments are those of ``train``, and the bits do not depend on
    where it was interrupted.
    """
    run = RunDirectory(directory)
    settings: dict[str, Any] = {"report": report, "checkpoint_every": checkpoint_every}
    if not (directory / "config.json").is_file():
        train(network, recipe, directory=directory, **settings, **options)
    elif run.status["state"] != "complete":
        resume(directory, **settings)
    return run


def export(run: str | Path | RunDirectory, folder: str | Path) -> list[Path]:
    """Write the policies that a run has chosen as ``LEARNER.zip``, and normalisers as ``LEARNER.normaliser.pkl``.

    ``stable_baselines3.PPO.load`` and ``VecNormalize.load`` read them, and run whatever code such files contain: load
    only what you wrote yourself. Optimisers and replay buffers are not in them.

    Raises:
        RunError: if the run is incomplete, or ``folder`` exists and is no folder.
    """
    source = run if isinstance(run, RunDirectory) else RunDirectory(run)
    if (target := Path(folder)).exists() and not target.is_dir():
        raise RunError(f"{target}: is no folder")
    env, files = source.make_env(source.config.envs), list[Path]()
    with publish_folder(target) as partial:
        for group in source.groups():
            learner = Learner(AgentVecEnv(env, group.name, group.view(env)), group.spec, source.config.seed).build()
            learner.take(source.acting_checkpoint).model.save(partial / f"{group.name}.zip")
            files.append(target / f"{group.name}.zip")
            if learner.normaliser is not None:
                learner.normaliser.save(str(partial / f"{group.name}.normaliser.pkl"))
                files.append(target / f"{group.name}.normaliser.pkl")
    return files


class Trained(Policies):
    """Acts by the policies of the checkpoint that a run has chosen.

    Each sees what it learnt from, whatever the environment shows. ``checkpoint`` is the folder from which they were
    loaded; a run that is being trained has others later.
    """

    def __init__(self, run: str | Path | RunDirectory) -> None:
        """Load every policy; a ``RunError`` if the run is incomplete or a file of it cannot be read."""
        self.run = run if isinstance(run, RunDirectory) else RunDirectory(run)
        self.checkpoint = folder = self.run.acting_checkpoint
        env = self.run.make_env(1)
        self._names, self._shown = env.layout.names, (env.layout.mode, env.layout.countdown)
        groups = self.run.groups()
        policies = {group.name: load_acting_learner(folder, group, env).policy for group in groups}
        super().__init__(policies)

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Forget the last episode; a ``RunError`` if ``env`` has other agents, or not what they learnt from."""
        if set(env.agents) != set(self._names):
            raise RunError(f"{self.run.path}: trained {sorted(self._names)}, not {sorted(env.agents)}")
        self._env, self._layout = env, env.layout
        if env.layout.names != self._names:
            mode, countdown = self._shown
            self._layout = ObservationLayout(env.dynamics, env.agents, mode, env.num_envs, countdown)
        for agent, entries in self._names.items():
            if (seen_here := self._layout.names[agent]) != entries:
                counts = f"{len(seen_here)} entries, not {len(entries)}"
                difference = next((name for name in seen_here if name not in entries), counts)
                raise RunError(f"{self.run.path}: '{agent}' learnt from other observations ({difference})")
        super().start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return each policy's deterministic action, which depends on what its agents learnt from alone."""
        if self._layout is not self._env.layout:
            observations = self._layout.by_agent(self._env.stacked_observation(layout=self._layout))
        return super().act(observations)
