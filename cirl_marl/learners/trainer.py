"""The trainer: learners run in lockstep or stacked, are validated and saved; the best policies are chosen."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls
from stable_baselines3.common.callbacks import BaseCallback

from cirl_marl.environments.rewards import CIRCULARITY_REWARDS
from cirl_marl.environments.vector import Infos, MultiAgentVectorEnv
from cirl_marl.errors import CirlError, RecipeError, RunError, instance_of, unknown_name
from cirl_marl.learners.checkpoint import read_tree, write_tree
from cirl_marl.learners.demonstrations import Demonstrator
from cirl_marl.learners.learner import Learner, derived_seed, has_tensorboard
from cirl_marl.learners.lockstep import Lockstep, NetworkWorld, Participant, Streams, TrainingStop
from cirl_marl.learners.recipe import Start
from cirl_marl.learners.run_directory import RunConfig, RunDirectory, TableFile, steps_of
from cirl_marl.learners.stacked.conditions import gradient_obstacle, gradient_stacks, obstacle, stacks
from cirl_marl.learners.stacked.gradient_ascent import GradientStack
from cirl_marl.learners.stacked.stack import Stack, StackedPolicies
from cirl_marl.learners.start import begin_again, begin_from
from cirl_marl.learners.validation import Multipliers, Rank, Score, validation_score
from cirl_marl.network import Floats
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import CIRCULARITY
from cirl_marl.optimum.aims import aims_of

CHECKPOINTS = 10
"""Checkpoints of a run, evenly spaced."""
CHECKPOINT_EVERY = 60.0
"""Seconds after which there is one more; a crash loses at most what came after the last."""
STOPS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""Signals at which a training is saved and stopped; some systems lack the last."""
EPISODE_COLUMNS = ("joint_step", "env_steps", "seconds", "circularity", "service_level")
"""Columns of ``metrics.csv``, before the returns."""
EVALUATION_COLUMNS = (
    "joint_step", "env_steps", "circularity", "service", "assured", "paid", "circularity_weight", "best",
)  # fmt: skip
"""Columns of ``evaluations.csv``."""
REPAIRS, LONGEST = 10, 16.0
"""Policies that are tried near the last ones, each step at most so many times as long as the one before."""
CUSHION = 0.05
"""Part of what lacks most by which they are to keep more than is demanded."""
RIDGE = 1e-9
"""Part of the largest response below which another counts as none."""
COST = 0.02
"""Part of the time that checkpoints may take; they come less often if the last one took more."""


@positional_record
class Progress:
    """What a running training reports."""

    env_steps: Annotated[int, "environment steps done in this call, summed over the copies, of ``total``"]
    total: int
    seconds: Annotated[float, "since training began"]
    circularity: Annotated[float, "mean over copies of λ at the end of the last step, or λ̄ of the last episode; mass"]
    service_level: Annotated[float, "likewise"]
    episode: Annotated[bool, "whether the two figures are those of a finished episode"]


TrainingReport = Callable[[Progress], None]


class Training:
    """A run in progress: what it was asked to do, the joint environment, its learners by name, and where it is kept."""

    def __init__(
        self,
        config: RunConfig,
        env: MultiAgentVectorEnv,
        checkpoint: Path | None = None,
        checkpoint_every: float | None = None,
    ) -> None:
        """Make the learners, or load those of a ``checkpoint`` from which a run is resumed.

        ``checkpoint_every`` are seconds, 0 for no checkpoints by time and None for a minute.
        """
        self.config = config
        self.env = env
        self.run: RunDirectory | None = None
        self._metrics: TableFile | None = None
        self._evaluations: TableFile | None = None
        self._best: Score | None = None
        self._last_score: Score | None = None
        self._stacks: Sequence[Stack] = ()
        self._saved_state = None
        self.done = 0 if checkpoint is None else steps_of(checkpoint)
        if checkpoint is not None and (checkpoint / "training.json").is_file():
            self._saved_state = read_tree(checkpoint, "training")
        self.first_step = self.done if self._saved_state is None else int(self._saved_state["begun"])
        alike = config.recipe.run.common_random_numbers
        seeds = [derived_seed(config.seed, "copies", 0 if alike else i, self.first_step) for i in range(config.envs)]
        self.groups = {group.name: group for group in config.recipe.groups(env.network, env.agents)}
        views = {name: group.view(env) for name, group in self.groups.items()}
        self.world = NetworkWorld(env, seeds, views, done=self.first_step)
        self.learners: dict[str, Learner] = {}
        with one_torch_thread():
            for name, agent_env in self.world.agent_envs.items():
                learner = Learner(agent_env, self.groups[name].spec, config.seed, done=self.first_step)
                if checkpoint is None or checkpoint.name.endswith("-start"):
                    self.learners[name] = learner.build()
                elif self._saved_state is None:
                    self.learners[name] = learner.load(checkpoint)
                else:
                    self.learners[name] = learner.restore(checkpoint)
        if checkpoint is None:
            runs = {name: start.run for name, start in self.starts.items() if start.run is not None}
            self.begin_from({name: run.replace("{seed}", str(config.seed)) for name, run in runs.items()})
        elif checkpoint.name.endswith("-start"):
            for name in self.starts:
                begin_again(checkpoint, self.learners[name])
        self._aims = aims_of(env.network, CIRCULARITY, config.recipe.run.at_most)
        self._multiplier = self._constraint_multipliers()  # its least price is the recipe's, not one that has moved
        if self._saved_state is not None:
            self.world.load_state_dict(self._saved_state["world"])
        if self._multiplier is not None and checkpoint is not None:
            self._multiplier.load(checkpoint)
        run_settings = config.recipe.run
        self._validation_env: MultiAgentVectorEnv | None = None
        if run_settings.evaluations:
            self._validation_env = MultiAgentVectorEnv(
                env.network, num_envs=run_settings.episodes if env.is_random else 1, agents=env.agents, **config.options
            )
        # from here on only what all updates have made is evaluated, once nobody learns any more
        self._last_steps = max(group.spec.steps_of(config.steps) for group in self.groups.values()) // config.envs
        self._checkpoint_folder: Path | None = None
        self._stack_names: Container[str] = ()
        self._due, self._saved_at, self._checkpoint_seconds = False, time.monotonic(), 0.0
        self._shortest_interval = CHECKPOINT_EVERY if checkpoint_every is None else checkpoint_every
        self._checkpoint_interval = self._shortest_interval or None
        self._appoint_demonstrators()

    @property
    def starts(self) -> dict[str, Start]:
        """What learners begin with, by name, of those that begin with something."""
        return {name: learner.spec.start for name, learner in self.learners.items() if learner.spec.start is not None}

    def begin_from(self, runs: Mapping[str, str | Path]) -> None:
        """Give learners, by name, the policies that ``runs`` learnt; a ``RecipeError`` names what does not fit."""
        starts = self.starts
        origins = {name: begin_from(self.learners[name], starts[name], self.env, run) for name, run in runs.items()}
        self.config = self.config.model_copy(update={"origins": self.config.origins | origins})

    def _constraint_multipliers(self) -> Multipliers | None:
        """Return the multipliers of the services and budgets if they move."""
        settings = self.config.recipe.run
        by_evaluations = bool(settings.price_rate) and settings.engine != "gradients"
        is_constrained = bool(self.env.network.services or settings.at_most)
        if not by_evaluations or settings.min_service is None or not is_constrained:
            return None
        if self.env.reward_mode not in CIRCULARITY_REWARDS:
            raise RecipeError(
                f"recipe '{self.config.recipe.name}': run.price_rate: reward '{self.env.reward_mode}' has no price of "
                f"service that could move; choose {', '.join(CIRCULARITY_REWARDS)}, or a price_rate of 0"
            )
        rates = settings.price_rate, settings.price_damping
        return Multipliers(self.env, settings.min_service, *rates, settings.at_most)

    def keep_in(self, run: RunDirectory) -> None:
        """Keep metrics, logs, checkpoints and the best of them in ``run`` from now on."""
        self.run, self.config = run, run.config
        columns = (*EPISODE_COLUMNS, *(f"return:{agent}" for agent in self.env.agents))
        self._metrics = TableFile(run.path / "metrics.csv", columns, self.done)
        self._saved_at = time.monotonic()
        for name, learner in self.learners.items():
            learner.barrier.write = partial(self._write_learner, learner)
            if has_tensorboard():
                learner.log_to_tensorboard(run.path / "tensorboard" / name)
        best = run.status["best"]
        self._best = Score.from_dict(best["figures"]) if best is not None else None
        self._evaluations = TableFile(run.path / "evaluations.csv", EVALUATION_COLUMNS, self.done)
        if self.config.origins and self.joint_steps == 0:  # the run shall not need those from which it started
            folder = run.begin_checkpoint()
            self._write_policies(folder)
            run.end_checkpoint(folder, 0, "start")

    def _appoint_demonstrators(self) -> None:
        """Give learners that have demonstrations to come a controller to follow, learners of the same one together."""
        demonstrators: dict[str, Demonstrator] = {}
        for learner in self.learners.values():
            if learner.spec.demonstrations is not None and learner.demonstrations:
                name = learner.spec.demonstrations.controller
                seed = derived_seed(self.config.seed, "demonstrations", name, self.done)
                leader = demonstrators.setdefault(name, Demonstrator(name, self.env, seed))
                leader.check(learner.agent_env.view.agents, learner.agent_env.title)
                learner.demonstrator = leader

    def check_callbacks(self, callbacks: Mapping[str, BaseCallback]) -> None:
        """Raise a ``CirlError`` for callbacks of learners that there are not, or that run as one, and for what is none.

        A callback knows the model of one learner, so that it cannot be that of two.
        """
        engine, owners = self.config.recipe.run.engine, dict[int, str]()
        for name, callback in instance_of(Mapping, "callbacks", callbacks).items():  # type: ignore[type-abstract]
            subject = f"callbacks: that of '{name}'"
            if name not in self.learners:
                raise CirlError(f"callbacks: {unknown_name('learner', name, self.learners)}")
            if engine in ("stacked", "gradients"):
                title = self.learners[name].agent_env.title
                raise CirlError(f"callbacks: {title}: engine {engine} calls none; use engine lockstep or auto")
            if not isinstance(callback, BaseCallback | None):
                raise CirlError(f"{subject} must be a BaseCallback, several a CallbackList of them, got {callback!r}")
            if callback is not None and owners.setdefault(id(callback), name) != name:
                raise CirlError(
                    f"{subject} is that of '{owners[id(callback)]}' too, and knows one model only; make two"
                )

    def stackable(self, callbacks: Mapping[str, BaseCallback]) -> list[Learner]:
        """Return the learners that the engine of the run lets run as one with others.

        Raises:
            RecipeError: if one cannot that has to; names it and what is in the way.
        """
        engine, members = self.config.recipe.run.engine, list[Learner]()
        for learner in self.learners.values():
            title, reason = learner.agent_env.title, obstacle(learner)
            if engine == "gradients":
                reason = gradient_obstacle(learner, next(iter(self.learners.values())).spec)
            if engine in ("stacked", "gradients") and reason is not None:
                place = f"recipe '{self.config.recipe.name}': {title}: engine {engine}"
                other = ", or another recipe, such as independent_ars" if engine == "gradients" else ""
                raise RecipeError(f"{place}: {reason}; use engine auto or lockstep{other}")
            if reason is None and engine == "lockstep":
                reason = "engine lockstep"
            elif reason is None and learner.name in callbacks:
                reason = "a callback"
            if reason is None:
                members.append(learner)
            elif learner.spec.start is not None and learner.spec.start.last_layer:
                raise RecipeError(f"{title}: start.last_layer: needs a stacked ARS, which {reason} prevents")
        return members

    @property
    def best(self) -> Score | None:
        """Figures of the checkpoint that acts; None if none was evaluated."""
        return self._best

    @property
    def joint_steps(self) -> int:
        """Joint steps done, those before a resumption included."""
        return self.world.joint_steps

    def after_step(self, began: float, report: TrainingReport | None, infos: Infos, dones: NDArray[np.bool_]) -> None:
        """Report, record finished episodes, evaluate, save checkpoints."""
        seconds, copies, steps = time.perf_counter() - began, self.env.num_envs, self.joint_steps
        has_ended = bool(dones.any())
        if has_ended or report is not None:
            first, rows = infos[self.env.agents[0]], dones if has_ended else slice(None)
            names = ("episode_circularity", "episode_service_level") if has_ended else ("circularity", "service_level")
            circularity, service = (float(first[name][rows].mean()) for name in names)
            if report is not None:
                total = max(self.config.steps, steps * copies) - self.done * copies
                report(Progress((steps - self.done) * copies, total, seconds, circularity, service, has_ended))
            if has_ended and self._metrics is not None:
                returns = [float(info["episode_return"][dones].mean()) for info in infos.values()]
                total_seconds = seconds + self._metrics.last.get("seconds", 0.0)
                self._metrics.append([steps, steps * copies, total_seconds, circularity, service, *returns])
        total_steps = self.config.steps // copies
        if self.config.recipe.run.evaluations:
            interval = max(self.env.network.episode.horizon, total_steps // self.config.recipe.run.evaluations)
            if steps % interval == 0 and steps < self._last_steps:
                self._evaluate()
        if steps % max(1, total_steps // CHECKPOINTS) == 0:
            self._due = True

    def finish(self) -> None:
        """Evaluate what was learnt in the end, and keep it."""
        self._evaluate()
        self._bring_up_to_date()
        if self.run is not None:
            self._repair()
            partial_folder = self.run.begin_checkpoint()
            for learner in self.learners.values():
                learner.write_state(partial_folder, {}, last=True)
            self._end_checkpoint(partial_folder, "complete")

    def stop(self, state: str, reason: str) -> None:
        """Say that the training ended early; it goes on from the last checkpoint. What failed can be looked at."""
        if self.run is None:
            return
        if state == "failed":
            self._bring_up_to_date()
            self.run.save_policies(f"{self.joint_steps:09d}-failed", self._write_policies)
        self.run.stop(state, reason)

    @property
    def due(self) -> bool:
        """Whether it is time for a checkpoint."""
        if self.run is None or self._checkpoint_folder is not None:
            return False
        waiting_time = time.monotonic() - self._saved_at
        late = self._checkpoint_interval is not None and waiting_time >= self._checkpoint_interval
        return late or (self._due and waiting_time * COST >= self._checkpoint_seconds)

    def ask(self) -> None:
        """Ask every learner for its state."""
        if self.run is not None and self._checkpoint_folder is None:
            began = time.perf_counter()
            self._checkpoint_folder = self.run.begin_checkpoint()
            self._checkpoint_seconds = time.perf_counter() - began
            for learner in self.learners.values():
                learner.barrier.folder = self._checkpoint_folder

    def keep(self, state: str) -> None:
        """Complete the checkpoint for which every learner has written its state; ``state`` is part of its name."""
        if self.run is None or self._checkpoint_folder is None:
            return
        began = time.perf_counter()
        for learner in self.learners.values():
            learner.write_journal(self._checkpoint_folder)
            learner.barrier.release()
        tree = {"begun": self.first_step, "world": self.world.state_dict(), "best": self.run.status["best"]}
        write_tree(self._checkpoint_folder, "training", tree)
        self._end_checkpoint(self._checkpoint_folder, state)
        self._checkpoint_folder, self._due, self._saved_at = None, False, time.monotonic()
        self._checkpoint_seconds += time.perf_counter() - began
        if self._checkpoint_interval is not None:
            self._checkpoint_interval = max(self._shortest_interval, self._checkpoint_seconds / COST)

    def _end_checkpoint(self, folder: Path, state: str) -> None:
        assert self.run is not None
        if self._multiplier is not None:
            self._multiplier.save(folder)
        self.run.end_checkpoint(folder, self.joint_steps, state)

    def _write_learner(self, learner: Learner, folder: Path, more: dict[str, Any]) -> None:
        """Write the state of a learner, and note how long it took."""
        began = time.perf_counter()
        learner.write_state(folder, more, in_stack=learner.name in self._stack_names)
        self._checkpoint_seconds += time.perf_counter() - began

    def evaluate_start(self) -> None:
        """Keep what the learners begin with as the best so far, if they begin with something; no price moves."""
        if self.starts and self.joint_steps == 0 and self._best is None:
            self._validate()

    def _evaluate(self) -> None:
        """Validate the policies of now, and move the multiplier."""
        score = self._validate()
        if score is not None and self._multiplier is not None:
            self._multiplier.update([*score.levels.values()], score.accounts)

    def _validate(self) -> Score | None:
        """Validate the policies of now, and keep them if they are the best so far; None if the run has none chosen."""
        if self._validation_env is None:
            return None
        self._bring_up_to_date()
        policies = StackedPolicies(self.learners, self._stacks)
        score = validation_score(self._validation_env, policies, self._aims)
        self._last_score = score
        better = self._keep_if_best(score)
        if self._evaluations is not None:
            steps = (self.joint_steps, self.joint_steps * self.config.envs)
            row = (score.circularity, score.service, score.service_bound, score.episode_return)
            self._evaluations.append([*steps, *row, self.env.circularity_weight, better])
        return score

    def _keep_if_best(self, score: Score) -> bool:
        """Let the policies of now act if their ``score`` is the best so far; return whether it is."""
        if self._best is not None and self._rank(score) <= self._rank(self._best):
            return False
        self._best = score
        if self.run is not None:
            self.run.save_best(self.joint_steps, self._write_policies, score.as_dict())
        return True

    def _rank(self, score: Score) -> Rank:
        budgets = {budget.name: budget.most for budget in self._aims.budgets}
        return score.rank(self.config.recipe.run.min_service, budgets)

    def _repair(self) -> None:
        """Where the last policies of exact gradients lack what is demanded, let the nearest act that do not.

        Policies move up the slopes G of what is demanded, by θ + Gᵀ w: where they are the best for some prices, these
        are what it costs. How outcomes respond to w is first G Gᵀ, then what validations show (Broyden 1965, A class of
        methods for solving nonlinear simultaneous equations).
        """
        last, settings = self._last_score, self.config.recipe.run
        if settings.engine != "gradients" or last is None or settings.min_service is None or self._rank(last)[0]:
            return
        stack = next(stack for stack in self._stacks if stack.members[0] in self.learners.values())
        assert isinstance(stack, GradientStack)
        end, slopes = stack.parameters, stack.slopes()
        gram, margins = slopes @ slopes.T, self._margins(last)
        weights, response, cushion = np.zeros(len(gram)), gram, -CUSHION * float(margins.min())
        length = math.inf
        for _ in range(REPAIRS):
            goal = least_weights(gram, response, response @ weights + cushion - margins)
            step = goal - weights
            if not (size := float(np.linalg.norm(step))):
                break
            step *= min(1.0, LONGEST * length / size)
            length = float(np.linalg.norm(step))
            weights = weights + step
            stack.parameters = end + torch.as_tensor(weights @ slopes, dtype=end.dtype, device=end.device).view_as(end)
            assert self._validation_env is not None
            score = validation_score(self._validation_env, StackedPolicies(self.learners, [stack]), self._aims)
            self._keep_if_best(score)
            change, margins = self._margins(score) - margins, self._margins(score)
            response = response + np.outer(change - response @ step, step) / length**2
            if self._rank(score)[0] and margins.min() <= 2.0 * cushion:
                break
        stack.parameters = end

    def _margins(self, score: Score) -> Floats:
        """Return by how much each level is kept, and each budget in parts of it, shape (services + budgets,)."""
        amounts = np.array([score.accounts[budget.name] for budget in self._aims.budgets])
        levels = np.array([*score.levels.values()]) - self.config.recipe.run.min_service
        return np.concatenate([levels, (self._aims.limits - amounts) / self._aims.sizes])

    def _write_policies(self, folder: Path) -> None:
        for learner in self.learners.values():
            learner.save(folder)
        if self._multiplier is not None:
            self._multiplier.save(folder)

    def _bring_up_to_date(self) -> None:
        for stack in self._stacks:
            stack.give()

    def runs_stacked(self, stacks_of_learners: Sequence[Stack], names: Container[str]) -> None:
        """Have the ``names`` learners act by their stacks, which bring their models up to date before they are saved.

        Raises:
            RunError: if a learner goes on that ran by itself, and now would not, or the other way round.
        """
        self._stacks, self._stack_names = stacks_of_learners, names
        for name, learner in self.learners.items():
            if learner.was_in_stack is not None and learner.was_in_stack != (name in names):
                before, now = ("stacked", "by itself") if learner.was_in_stack else ("by itself", "stacked")
                title = learner.agent_env.title
                raise RunError(f"{title} learnt {before} and would go on {now}: give the same callbacks")


def least_weights(gram: Floats, response: Floats, needs: Floats) -> Floats:
    """Return the least w of those with R w ≥ ``needs``: min ½ wᵀ K w by its dual, w = K⁻¹ Rᵀ μ with μ ≥ 0.

    K is ``gram``, R ``response``, both of shape (n, n); zero where nothing responds.
    """
    ridge = np.eye(len(gram)) * RIDGE
    ways = np.linalg.solve(gram + ridge * (gram.max() or 1.0), response.T)
    dual = response @ ways
    root = np.linalg.cholesky((dual + dual.T) / 2 + ridge * (dual.max() or 1.0))
    weights: Floats = ways @ nnls(root.T, np.linalg.solve(root, needs), maxiter=1000)[0]
    return weights


def run_together(
    trainings: Sequence[Training],
    *,
    callbacks: Mapping[str, BaseCallback] | None = None,
    report: TrainingReport | None = None,
    device: str = "cpu",
) -> None:
    """Train to the end of the budget; several trainings step by step together, learners of all of them stacked.

    They have the same recipe, steps and copies; ``report`` is called after every joint step of the first of them.
    ``callbacks`` and ``device`` are those of ``train``.

    Raises:
        LearnerError: if a learner fails; what was learnt is saved first, as it is after Ctrl-C.
        RecipeError: if the engine cannot stack a learner that it should.
    """
    callbacks = callbacks or {}
    members = [learner for training in trainings for learner in training.stackable(callbacks)]
    run_settings = trainings[0].config.recipe.run
    if run_settings.engine == "gradients":
        by_training = [training.learners.values() for training in trainings]
        stacks_of_learners = gradient_stacks(by_training, device, run_settings)
    else:
        stacks_of_learners = stacks(members, device)
    member_ids = {id(learner) for learner in members}
    began = time.perf_counter()

    for training in trainings:
        names = {name for name, learner in training.learners.items() if id(learner) in member_ids}
        training.runs_stacked(stacks_of_learners, names)
    reports: list[TrainingReport | None] = [report] + [None] * (len(trainings) - 1)
    try:
        with one_torch_thread(), _interruption() as stop_requested:
            for training in trainings:
                training.evaluate_start()
            hooks = [partial(t.after_step, began, observer) for t, observer in zip(trainings, reports, strict=True)]
            participants = list(_participants(trainings, stacks_of_learners, callbacks))
            lockstep = Lockstep([t.world for t in trainings], participants)
            lockstep.run(hooks, partial(_keep, trainings, lockstep, stop_requested))
            for training in trainings:
                training.finish()
    except TrainingStop:
        for training in trainings:
            training.stop("interrupted", "stopped by the user")
        raise KeyboardInterrupt from None
    except Exception as error:
        for training in trainings:
            training.stop("failed", str(error).partition("\n")[0] or repr(error))
        raise
    finally:
        for training in trainings:
            for learner in training.learners.values():
                learner.model.logger.close()


def _keep(trainings: Sequence[Training], lockstep: Lockstep, stop_requested: Callable[[], bool]) -> None:
    """Ask for checkpoints when it is time, or when somebody wants to stop, and write those that are complete.

    Raises:
        TrainingStop: when everything is written, or if a learner follows a demonstrator, as it cannot be saved then.
    """
    stops = stop_requested()
    if stops and (lockstep.busy or all(training.run is None for training in trainings)):
        raise TrainingStop
    if stops or (any(training.due for training in trainings) and not lockstep.busy):
        for training in trainings:
            training.ask()
    if lockstep.all_have_saved:
        for training in trainings:
            training.keep("interrupted" if stops else "running")
        if stops:
            raise TrainingStop


def _participants(
    trainings: Sequence[Training], stacks: Sequence[Stack], callbacks: Mapping[str, BaseCallback]
) -> Iterator[Participant]:
    """Yield who acts: each stack, then every other learner, in the order of the agents."""
    steps = trainings[0].config.steps
    for stack in stacks:
        titles = [member.agent_env.title for member in stack.members]
        title = f"the stack of {', '.join(titles[:3] + ['…'] * (len(titles) > 3))}"
        barriers = [member.barrier for member in stack.members]
        yield Participant(title, partial(stack.learn, steps), stack.act, Streams(), barriers)
    member_ids = {id(member) for stack in stacks for member in stack.members}
    for training in trainings:
        for name, learner in training.learners.items():
            if id(learner) not in member_ids:
                title, learn = learner.agent_env.title, partial(learner.learn, steps, callbacks.get(name))
                limits = partial(getattr, learner, "follows_demonstrator"), partial(learner.budget, steps)
                yield Participant(title, learn, learner.act, learner.streams, [learner.barrier], *limits)


@contextmanager
def _interruption() -> Iterator[Callable[[], bool]]:
    """Yield what says whether somebody wants to stop: Ctrl-C, SIGTERM or SIGHUP; the second time they act as usual."""
    request = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield request.is_set
        return
    before = {number: signal.getsignal(number) for number in STOPS}

    def note(_signal: int, _frame: FrameType | None) -> None:
        request.set()
        back()

    def back() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    for number in STOPS:
        signal.signal(number, note)
    try:
        yield request.is_set
    finally:
        back()


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Small networks learn fastest on one thread, and trainings may run side by side."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
