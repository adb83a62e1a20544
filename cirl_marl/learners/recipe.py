"""Learner recipes: which algorithm each agent learns with, alone or together, read from ``agents/*.toml``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    StrictBool,
    StrictStr,
    ValidationError,
    WithJsonSchema,
    field_validator,
    model_serializer,
)
from pydantic_core import PydanticCustomError

from cirl_marl.definitions.catalogue import recipe_path
from cirl_marl.definitions.error_messages import validation_mistakes
from cirl_marl.definitions.quantities import Number
from cirl_marl.definitions.reader import read_toml
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, DefinitionError, RecipeError, unknown_name
from cirl_marl.learners.views import CENTRAL_CRITIC, AllAtOnce, OneAgent, Scheme, SharedPolicy, View
from cirl_marl.network import Network
from cirl_marl.network.elements import Moment, Node, Observe, Reward, Role

EngineName = Literal["auto", "lockstep", "stacked", "gradients"]
ENGINES: tuple[EngineName, ...] = get_args(EngineName)
Count = Annotated[int, Field(strict=True, gt=0)]
Limit = Annotated[Number, Field(gt=0)]


class Settings(BaseModel):
    """Named values, none of them unknown, that do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    LATER: ClassVar[tuple[str, ...]] = ()
    """Fields that version 0.1.0 lacks: they are written if they say something, so that cells of sweeps keep names."""

    @model_serializer(mode="wrap")
    def _without_later_defaults(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        settings: dict[str, Any] = write(self)
        defaults = {key: type(self).model_fields[key].default for key in self.LATER}
        return {key: value for key, value in settings.items() if key not in defaults or value != defaults[key]}


class Options(Settings):
    """What a recipe may say of the environment; None takes the definition's."""

    LATER = ("countdown",)

    reward: Reward | None = None
    observe: Observe | None = None
    countdown: StrictBool | None = None
    circularity: Moment = "end"
    circularity_weight: Annotated[Number, Field(ge=0, le=1)] | None = None
    charges: dict[StrictStr, Number] = Field(
        {}, description="what a unit of each account costs in rewards with λ, in units of mass"
    )
    horizon: Count | None = None
    uncertain: StrictBool = False
    scenario: StrictStr | None = None


OPTIONS = tuple(Options.model_fields)


class Normalisation(Settings):
    """Running normalisation by Stable-Baselines3's ``VecNormalize``, one per agent, saved with its policy."""

    LATER = ("epsilon",)
    observation: StrictBool = True
    reward: StrictBool = True
    clip_observation: Limit = 10.0
    clip_reward: Limit = 10.0
    epsilon: Limit = Field(
        1e-8,
        description="added to each variance: what varied less than its root while the learner learnt is not magnified, "
        "so that the policy also acts where it differs",
    )

    @property
    def is_on(self) -> bool:
        """Whether anything is normalised."""
        return self.observation or self.reward


class Demonstrations(Settings):
    """A controller that acts in the learner's place at first, while the learner keeps what it sees."""

    controller: Literal["neutral", "random", "scripted", "lqr", "mpc", "optimum"]
    steps: Count = Field(
        description="environment steps, summed over the copies; they are the first of the run and count as such"
    )


class Start(Settings):
    """What was learnt before, with which a learner begins: in another run, or by another recipe that comes first."""

    LATER = ("recipe", "steps")
    run: Annotated[StrictStr, Field(min_length=1)] | None = Field(
        None,
        description="directory of the run; a relative path counts from the working directory, as that of cirl train; "
        "{seed} stands for the seed of the training",
    )
    agent: StrictStr | None = Field(None, description="learner of that run; None is the one of the same name")
    last_layer: StrictBool = Field(
        False,
        description="whether only the last layer goes on learning: a search of whole episodes that moves a few hundred "
        "weights instead of thousands. For ARS that can be stacked",
    )
    recipe: Annotated[StrictStr, Field(min_length=1)] | None = Field(
        None,
        description="instead of a run: recipe that learns first, in the same network, with the same seed; what acts is "
        "taken of it, while critics and exploration begin as this recipe says",
    )
    steps: Count | None = Field(None, description="steps of that recipe; None is its own")

    @property
    def takes_critics(self) -> bool:
        """Whether critics and exploration are taken over, not only what acts."""
        return self.recipe is None

    @property
    def frozen_statistics(self) -> tuple[str, ...]:
        """Parts of observations whose statistics stay as they were: what critics see is new to critics that are."""
        return ("observation", "state") if self.takes_critics else ("observation",)

    def mistakes(self, algorithm: str) -> Iterator[str]:
        """Yield what is wrong with the start of a learner by ``algorithm``, whatever the network."""
        if self.last_layer and algorithm != "ARS":
            yield f"start.last_layer: is for ARS, not for {algorithm}"
        if (self.run is None) == (self.recipe is None):
            yield "start: needs either a run or a recipe that learns first"
        if self.recipe is None:
            if self.steps is not None:
                yield "start.steps: are those of a recipe that learns first; a run has its steps behind it"
            return
        try:
            first = Recipe.model_validate(read_toml(recipe_path(self.recipe)))
        except (CirlError, ValidationError) as error:
            yield f"start.recipe: {error}"
            return
        if any(spec.start is not None and spec.start.recipe for spec in (first.learner, *first.match)):
            yield f"start.recipe: '{first.name}' begins with a recipe itself; name one that begins with none"


class LearnerSettings(Settings):
    """One algorithm with its parameters."""

    LATER = ("centre_rewards",)
    algorithm: str
    policy: str = Field("MlpPolicy", description="CentralCriticPolicy lets the critic see the whole state")
    scheme: Scheme = Field(
        "independent",
        description="independent: a learner for each agent; shared: one policy for all, each acting by itself; "
        "joint: one policy that sees and acts for all at once",
    )
    among: Literal["all", "copies"] = Field(
        "all",
        description="all: one shared or joint policy for all agents; copies: one for each agent of a definition of "
        "which the network has copies, for that agent in all of them; agents of no copy learn by themselves",
    )
    parameters: dict[str, Any] = {}
    normalise: Normalisation = Normalisation()
    bootstrap: StrictBool = Field(
        True, description="whether the learner expects more to come after a time limit; if not, the episode is all"
    )
    centre_rewards: StrictBool = Field(
        False,
        description="whether the mean reward over the copies is taken off in each interval: what time alone brings is "
        "far more than an action does, and critics need to see that. Needs several copies",
    )
    share_of_steps: Annotated[Number, Field(ge=0, le=1)] = Field(
        1.0, description="share of the run during which the agent learns; after it, it only acts; 0 needs a start"
    )
    start: Start | None = Field(None, description="policy to begin with, of the same algorithm and for the same spaces")
    demonstrations: Demonstrations | None = Field(
        None, description="what fills the replay buffer of an off-policy learner, and what others imitate"
    )

    def steps_of(self, steps: int) -> int:
        """Return during how many of the ``steps`` of a run it learns, rounded up.

        >>> LearnerSettings(algorithm="PPO", share_of_steps=0.55).steps_of(100)
        55
        """
        return math.ceil(round(steps * self.share_of_steps, 6))

    def mistakes(self, steps: int) -> Iterator[str]:
        """Yield what is wrong whatever the network, in a run of ``steps``: key, value and what would do."""
        from cirl_marl.learners.algorithms import algorithm_mistakes, algorithms, can_be_shown

        yield from algorithm_mistakes(self.algorithm, self.policy, self.parameters)
        if self.policy == CENTRAL_CRITIC and not self.normalise.observation:
            yield f"normalise.observation: {CENTRAL_CRITIC} sees physical units, so it must be true"
        if self.start is not None:
            yield from self.start.mistakes(self.algorithm)
        if self.among == "copies" and self.scheme == "independent":
            yield "among: copies is for the schemes shared and joint; an independent learner has one agent"
        if self.share_of_steps == 0 and self.start is None:
            yield "share_of_steps: 0, so that it never learns: give a start by which it acts, or a share above 0"
        if self.demonstrations is None or self.algorithm not in algorithms():
            return
        if not can_be_shown(self.algorithm):
            fit = ", ".join(filter(can_be_shown, algorithms()))
            yield f"demonstrations: {self.algorithm} can neither keep nor imitate them; use one of {fit}"
        if self.demonstrations.steps > self.steps_of(steps):
            share = "" if self.share_of_steps == 1 else f" times share_of_steps {self.share_of_steps}"
            yield f"demonstrations.steps: {self.demonstrations.steps} is more than the {steps} steps of the run{share}"


class Match(LearnerSettings):
    """A learner for some agents only; of several matches the first applies."""

    kind: Literal["node", "arc"] | None = None
    role: Role | None = None
    agents: list[str] | None = None

    def fits(self, agent: str, network: Network) -> bool:
        """Return whether the match names ``agent``."""
        compartment = network.compartments[agent]
        kind, role = ("node", compartment.role) if isinstance(compartment, Node) else ("arc", None)
        is_listed = self.agents is None or agent in self.agents
        return is_listed and self.kind in (None, kind) and self.role in (None, role)


class Run(Settings):
    """How long and in how many copies, by which engine, and which checkpoint counts; the command line overrides it."""

    LATER = ("at_most",)
    steps: Count = Field(200_000, description="environment steps, summed over the copies")
    envs: Count = Field(16, description="copies of the environment")
    common_random_numbers: StrictBool = Field(
        False,
        description="whether episodes that run side by side begin alike and draw the same, so that they differ by what "
        "was done alone; the next ones begin elsewhere",
    )
    engine: EngineName = Field(
        "auto",
        description="lockstep: each learner's own learn(), unmodified; stacked: learners of the same settings as one, "
        "the same algorithm up to rounding and several times as fast; auto: stacks those that can be; gradients: "
        "policies of PPO, TD3, DDPG, SAC or TQC by exact gradients of the simulator instead of the algorithm",
    )
    evaluations: Annotated[int, Field(strict=True, ge=0)] = Field(
        20, description="evaluations during a run, the best of which is the checkpoint that counts; 0: the last one"
    )
    episodes: Count = Field(16, description="episodes of an evaluation")
    min_service: Annotated[Number, Field(ge=0, le=1)] | None = Field(
        None,
        description="level that every service must reach for a checkpoint to be the best; of those that do, the best "
        "has the highest mean circularity. Left out: the best is paid most",
    )
    at_most: dict[StrictStr, Number] = Field(
        {},
        description="budgets beside min_service: highest mean totals of accounts, in their units, or with ``/year`` "
        "highest mean amounts of each year, not discounted",
    )
    price_rate: Annotated[Number, Field(ge=0)] = Field(
        0.0,
        description="largest step of the logarithm of the price of a shortfall, each service's own, which moves after "
        "each evaluation until min_service is reached, after each episode with engine gradients; 0: the price stays "
        "that of circularity_weight. Budgets have such prices, too",
    )
    price_damping: Annotated[Number, Field(ge=0)] = Field(
        0.0,
        description="by how much the logarithm of that price is higher still, only as long as service is short by as "
        "much as it may be at all; lower as long as there is too much",
    )


@dataclass(frozen=True, slots=True)
class Group:
    """Agents that one learner learns for, in the order of the environment, and how it learns.

    An independent learner has the name of its agent, others are ``shared-learner`` or ``joint-learner``; of several
    with the number of the match, 0 for the common one. One that is for the same agent in all copies ends with its name.
    """

    name: str
    agents: tuple[str, ...]
    spec: LearnerSettings

    def view(self, env: MultiAgentVectorEnv) -> View:
        """Return how the learner sees ``env``."""
        view: View
        if self.spec.scheme == "independent":
            view = OneAgent(env, *self.agents)
        else:
            view = (SharedPolicy if self.spec.scheme == "shared" else AllAtOnce)(env, self.agents)
        return view.with_state(env) if self.spec.policy == CENTRAL_CRITIC else view


class Recipe(Settings):
    """A learner for each agent of a network."""

    name: str = Field(description="name in the catalogue")
    title: str = Field(description="one line for tables")
    run: Run = Field(Run(), description="defaults of a training run")
    environment: Annotated[dict[str, Any], WithJsonSchema(Options.model_json_schema())] = Field(
        {}, description="options of ``vector_env``, such as ``reward`` and ``observe``"
    )
    learner: LearnerSettings = Field(description="the learner of agents that no match names")
    match: list[Match] = Field([], description="learners of some agents")

    @field_validator("match", mode="before")
    @classmethod
    def _has_two_brackets(cls, match: object) -> object:
        if isinstance(match, Mapping):
            raise PydanticCustomError("one_bracket", "write [[match]], with two brackets")
        return match

    def learner_of(self, agent: str, network: Network) -> LearnerSettings:
        """Return the learner of ``agent``: that of the first match that fits, else the common one."""
        return next((match for match in self.match if match.fits(agent, network)), self.learner)

    def groups(self, network: Network, agents: Sequence[str]) -> tuple[Group, ...]:
        """Return the learners of ``agents``, in the order of their first agents."""
        specs = [self.learner, *self.match]
        groups: dict[str, Group] = {}
        for agent in agents:
            spec = self.learner_of(agent, network)
            name = agent
            if spec.scheme != "independent":
                alike = sum(settings.scheme == spec.scheme for settings in specs)
                number = next(i for i, settings in enumerate(specs) if settings is spec)
                name = f"{spec.scheme}-learner" + (f"-{number}" if alike > 1 else "")
                if spec.among == "copies":
                    if not network.copies:
                        reason = f"network '{network.name}' is not made of copies ([copies]); use all"
                        self._refuse([f"among: copies, but {reason}"])
                    name += f"-{network.counterpart(agent) or agent}"
            members = groups[name].agents if name in groups else ()
            groups[name] = Group(name, (*members, agent), spec)
        return tuple(groups.values())

    def check(self, steps: int) -> None:
        """Raise a ``RecipeError`` that names all that is wrong whatever the network, in a run of ``steps``."""
        self._refuse(self.mistakes(steps))

    def check_agents(self, agents: Sequence[str]) -> None:
        """Raise a ``RecipeError`` for matches that name agents which do not act; it names the nearest that acts."""
        self._refuse(
            f"match.{i}.agents: {unknown_name('agent', agent, agents)}"
            for i, match in enumerate(self.match)
            for agent in match.agents or ()
            if agent not in agents
        )

    def check_copies(self, copies: int) -> None:
        """Raise a ``RecipeError`` that names learners who compare copies where there is but one."""
        self._refuse(
            f"{place}.centre_rewards: in a single copy nothing is left of them; give envs of at least 2"
            for place, learner in self.learners()
            if learner.centre_rewards and copies == 1
        )

    def _refuse(self, mistakes: Iterable[str]) -> None:
        text = "; ".join(mistakes)
        if text:
            raise RecipeError(f"recipe '{self.name}': {text}")

    def mistakes(self, steps: int) -> Iterator[str]:
        """Yield what is wrong whatever the network, in a run of ``steps``: key, value and what would do."""
        try:
            Options.model_validate(self.environment)
        except ValidationError as error:
            yield from (f"environment.{mistake}" for mistake in validation_mistakes(error, Options))
        for i, match in enumerate(self.match):
            if match.kind is None and match.role is None and match.agents is None:
                yield f"match.{i}: fits every agent; give kind, role or agents"
        if self.run.at_most and not (self.run.price_rate and self.run.min_service is not None):
            yield "run.at_most: budgets are kept beside min_service by prices that move: give that and a price_rate"
        if self.run.price_rate and (self.run.min_service is None or not self.run.evaluations):
            lacks = "evaluations are 0" if self.run.min_service is not None else "min_service is not given"
            yield f"run.price_rate: moves the price of service after evaluations to reach min_service, but {lacks}"
        for place, learner in self.learners():
            yield from (f"{place}.{mistake}" for mistake in learner.mistakes(steps))

    def learners(self) -> tuple[tuple[str, LearnerSettings], ...]:
        """Return every learner and what messages call its table."""
        return ("learner", self.learner), *((f"match.{i}", match) for i, match in enumerate(self.match))


def load_recipe(name: str | Path) -> Recipe:
    """Read a recipe of the catalogue, or of a file if ``name`` ends in ``.toml``.

    Raises:
        DefinitionError: if the file has mistakes; all are named.
    """
    path = recipe_path(name)
    document = read_toml(path)
    mistakes: list[str] = []
    try:
        recipe = Recipe.model_validate(document)
    except ValidationError as error:
        mistakes += validation_mistakes(error, Recipe)
        recipe = _sound_part(document, {str(item["loc"][0]) for item in error.errors()})
    mistakes += recipe.mistakes(recipe.run.steps)
    if mistakes:
        raise DefinitionError(str(path), mistakes)
    return recipe


def _sound_part(document: Mapping[str, Any], faulty: Set[str]) -> Recipe:
    """Return a recipe of the keys that are not ``faulty``, so that mistakes in what they hold are named as well."""
    stand_in = {"name": "?", "title": "?", "run": {"steps": 2**53}, "learner": {"algorithm": "PPO"}}
    sound = {key: value for key, value in document.items() if key not in faulty}
    return Recipe.model_validate(sound | {key: stand_in[key] for key in faulty & stand_in.keys()})
