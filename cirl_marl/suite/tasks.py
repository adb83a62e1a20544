"""Tasks and algorithms of the suite, as ``suite.toml`` declares them."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from cirl_marl.controllers.basic import Controller
from cirl_marl.controllers.rollout import first_seed, rollout
from cirl_marl.definitions.catalogue import load_network
from cirl_marl.definitions.ids import NAMESPACE
from cirl_marl.definitions.overrides import overlay
from cirl_marl.definitions.reader import read_toml
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, RunError, check_names, unknown_name, whole_number
from cirl_marl.evaluation.contenders import differences
from cirl_marl.evaluation.statistics import SHARE, Aggregate, over_episodes
from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.network import Network
from cirl_marl.network.declarations import frozen_record, positional_record
from cirl_marl.network.series import product
from cirl_marl.records.files import sha256_of
from cirl_marl.suite.task_bounds import TaskBound

VARIANTS = (1, 2, 3)
SPREAD = 0.05
"""Numbers are multiplied by factors that are uniform within 1 ± SPREAD."""

DECLARATION = Path(__file__).with_name("suite.toml")
PACKAGE_DATA = Path(__file__).with_name("kept")
"""Bounds, rows and weights that come with the package."""
CONTROLLERS = ("neutral", "best_constant", "best_schedule", "mpc")
"""First rows of every task: nobody acts, the best that never looks, and planning at each decision."""
HELD_OUT_EPISODES = 16


@positional_record
class Figures:
    """What a policy reaches in the episodes of a task."""

    circularity: Annotated[Aggregate, "λ̄, mass"]
    service: Annotated[Aggregate, "mean level of the service that lacks most"]
    gap: Annotated[Aggregate, "to the bound, with each service at its price; see ``TaskBound``"]


@frozen_record
class BenchmarkTask:
    """A task of the suite, or one of its held-out variants.

    A policy's *score* is 1 − gap within [0, 1] if the lowest service is at least ``min_service − tolerance``, else 0:
    who moves nothing and serves nobody has almost no gap, as the price of service is that at ``min_service``.
    """

    name: Annotated[str, "versioned, as ``copper_net-v0``; the id of the environment without its namespace"]
    steps: Annotated[int, "budget of a training, environment steps summed over copies"]
    episodes: Annotated[int, "of the evaluation"]
    seed: Annotated[int, "of the evaluation; of a world with disturbances the episodes are the draws of its bound"]
    seeds: Annotated[tuple[int, ...], "of trainings"]
    min_service: Annotated[float, "expected level demanded of every service"]
    tolerance: Annotated[float, "by which the lowest expected level may miss it"]
    sha256: Annotated[tuple[str, ...], "of the bounds of the task and of its variants"] = ()
    variant: Annotated[int, "0, or the number of the held-out variant"] = 0

    @property
    def id(self) -> str:
        """Id of the environment, which ``gymnasium.make`` and all functions that take a network know."""
        return NAMESPACE + self.name

    def network(self) -> Network:
        """Return the network; of a held-out variant with its own numbers."""
        network = load_network(self.id)
        return variant_of(network, self.variant) if self.variant else network

    @property
    def variants(self) -> tuple[int, ...]:
        """Held-out variants that have a bound; of tasks whose bounds take long there may be fewer than three."""
        return VARIANTS[: max(0, len(self.sha256) - 1)]

    def held_out(self, variant: int) -> BenchmarkTask:
        """Return a variant that no training sees: rates, demands and starts differ by up to 5 %, and so do the draws.

        Raises:
            CirlError: for another number than 1, 2 or 3.
        """
        if variant not in VARIANTS or self.variant:
            raise CirlError(f"task '{self.name}': held-out variants are {list(VARIANTS)}, got {variant!r}")
        episodes = min(self.episodes, HELD_OUT_EPISODES)
        return replace(self, variant=variant, seed=100 + variant, episodes=episodes)

    def env(self, episodes: int | None = None, **options: Any) -> MultiAgentVectorEnv:
        """Return the environment of the evaluation, with a copy for each episode; ``options`` as ``vector_env``'s."""
        return MultiAgentVectorEnv(self.network(), num_envs=self.episodes if episodes is None else episodes, **options)

    def bound(self) -> TaskBound:
        """Return what is proved of the task.

        Raises:
            RunError: if the file is missing, or not the one of this version.
        """
        path = self.bound_path
        if not path.is_file():
            raise RunError(f"task '{self.name}': its bound is missing: {path}")
        if self.sha256 and sha256_of(path) != self.sha256[self.variant]:
            raise RunError(f"{path}: is not the bound of '{self.name}', whose SHA-256 is {self.sha256[self.variant]}")
        return TaskBound.read(path)

    @property
    def bound_path(self) -> Path:
        """Where the bound is kept."""
        return PACKAGE_DATA / "bounds" / f"{self.name}{f'.{self.variant}' if self.variant else ''}.npz"

    def measure(self, controller: Controller, *, episodes: int | None = None, **options: Any) -> Figures:
        """Let a policy act in the episodes of the evaluation, and hold it against the bound.

        Args:
            controller: the policy, as ``rollout`` takes it.
            episodes: only the first so many; None: all.
            **options: of ``vector_env``, such as ``observe``: what the policy is used to.

        Raises:
            CirlError: for more episodes than the task has, or options by which they are others than those of its bound.
        """
        if episodes is not None and whole_number("episodes", episodes, 1) > self.episodes:
            raise CirlError(f"task '{self.name}': has {self.episodes} episodes, got episodes {episodes}")
        env = self.env(episodes, **options)
        if mismatches := "; ".join(differences(env, self.env(1, agents=env.agents))):
            raise CirlError(f"task '{self.name}': has no bound of other episodes: {mismatches}")
        run = rollout(env, controller, seed=first_seed(self.seed))
        levels = run.episode_levels
        lowest = levels[:, levels.mean(axis=0).argmin()] if levels.shape[1] else np.ones(len(levels))
        gaps = self.bound().gaps(run.episode_circularity, levels)
        return Figures(over_episodes(run.episode_circularity), over_episodes(lowest, SHARE), over_episodes(gaps))

    def score(self, gap: float, service: float) -> float:
        """Return the score of a policy with a mean gap and a lowest mean level of service.

        >>> load_task("copper_net-v0").score(gap=0.25, service=0.99)
        0.75
        """
        return min(1.0, max(0.0, 1.0 - gap)) if service >= self.min_service - self.tolerance else 0.0


@frozen_record
class SuiteAlgorithm:
    """A learner of the suite: a recipe, and what differs from it."""

    name: str
    recipe: Annotated[str, "of the catalogue"]
    share: Annotated[float, "of the steps of a task that it takes"] = 1.0
    changes: Annotated[Mapping[str, Any], "tables of the recipe, laid over it; parameters of another algorithm whole"]

    def recipe_of(self, task: BenchmarkTask) -> Recipe:
        """Return the whole recipe, which asks for the service that the task demands."""
        plain = load_recipe(self.recipe).model_dump(mode="json")
        plain["run"]["min_service"] = task.min_service
        changes = dict(self.changes)
        if "algorithm" in changes.get("learner", {}) or "scheme" in changes.get("learner", {}):
            plain["learner"]["parameters"] = {}
        return Recipe.model_validate(overlay(plain, changes) | {"name": self.name})

    def steps(self, task: BenchmarkTask) -> int:
        """Return the environment steps of a training on a task."""
        return round(self.share * task.steps)


def tasks() -> list[str]:
    """Return the names of the tasks of the benchmark.

    >>> tasks()[0]
    'copper_net-v0'
    """
    return list(_declaration()["tasks"])


def algorithms() -> list[str]:
    """Return the names of the learners of the benchmark."""
    return list(_declaration()["algorithms"])


def load_task(name: str) -> BenchmarkTask:
    """Return a task of the benchmark by name or id.

    Raises:
        CirlError: if there is none; names the nearest.
    """
    document, name = _declaration(), str(name).removeprefix(NAMESPACE)
    check_names("task", [name], document["tasks"])
    entry = dict(document["tasks"][name])
    common: dict[str, Any] = {key: document[key] for key in ("min_service", "tolerance")}
    lists: dict[str, Any] = {"seeds": tuple(document["seeds"]), "sha256": tuple(entry.pop("sha256", ()))}
    return BenchmarkTask(name=name, **{**common, **lists, **entry})


def load_algorithm(name: str) -> SuiteAlgorithm:
    """Return a learner of the benchmark by name.

    Raises:
        CirlError: if there is none; names the nearest.
    """
    document = _declaration()
    if name not in document["algorithms"]:
        raise CirlError(unknown_name("algorithm", name, (*CONTROLLERS, *document["algorithms"])))
    entry = dict(document["algorithms"][name])
    recipe, share = entry.pop("recipe"), entry.pop("share", 1.0)
    return SuiteAlgorithm(name=name, recipe=recipe, share=share, changes=entry)


@cache
def _declaration() -> dict[str, Any]:
    return read_toml(DECLARATION)


def variant_of(network: Network, variant: int) -> Network:
    """Return a network whose rates (of arcs and nodes), demands and initial ranges are multiplied by random factors.

    Both ends of a band or a range have one factor. The factors depend on network, scenario and variant alone.
    """
    key = zlib.crc32(f"{network.name}.{network.scenario_name}".encode())
    generator = np.random.default_rng([key, variant])

    def with_factor(part: Any, *names: str) -> Any:
        factor = float(generator.uniform(1.0 - SPREAD, 1.0 + SPREAD))  # drawn if it is not used, too: parts keep theirs
        numbers = {name: value for name in names if (value := getattr(part, name))}
        return replace(part, **{name: _times(value, factor) for name, value in numbers.items()})

    nodes = tuple(with_factor(with_factor(node, "rate"), "initial") for node in network.nodes)
    arcs = tuple(with_factor(arc, "rate") for arc in network.arcs)
    services = tuple(with_factor(service, "low", "high") for service in network.services)
    return network.variant(nodes=nodes, arcs=arcs, services=services)


def _times(value: Any, factor: float) -> Any:
    """Return a number, a series or both ends of a range times a factor."""
    return tuple(factor * end for end in value) if isinstance(value, tuple) else product(value, factor)
