"""Who is compared: trained policies and controllers that need no training, all in the same network."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Controller
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, RunError
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network import Network
from cirl_marl.optimum.draws import Prices
from cirl_marl.optimum.registry import CONTROLLERS, PLANNERS, TUNABLE, WITH_AIMS, controllers_by_margin


@dataclass(frozen=True, slots=True)
class Contender:
    """A policy or controller that is yet to act in its row of a comparison; ``seed`` and ``run`` are of its training.

    ``controller`` makes it, if it ``is_tunable`` with a margin, if it ``has_budgets`` with one on these, and ``env``
    the environment in which it acts, with so many copies.
    """

    name: str
    seed: int | None
    run: RunDirectory | None
    controller: Callable[..., Controller]
    env: Callable[[int], MultiAgentVectorEnv]
    is_tunable: bool = False
    has_budgets: bool = False


def contenders(
    runs: Sequence[RunDirectory],
    controllers: Sequence[str],
    network: Network | None,
    min_service: ArrayLike | None,
    uncertain: bool | None = None,
    *,
    futures: int | None = None,
    prices: Prices | None = None,
    at_most: Mapping[str, float] | None = None,
) -> tuple[list[Contender], MultiAgentVectorEnv]:
    """Return everyone who is compared, and a copy of the environment that they share.

    What a policy observes and is rewarded with is its own affair; network, acting agents and horizon must be the same.
    Uncertain numbers are drawn for all or none, by default as in the training of the runs.

    Raises:
        CirlError: if there is nothing to compare, a controller is unknown or named twice, or two runs are of one seed.
        RunError: if a run is incomplete, or of another environment; names it and what differs.
    """
    if not runs and network is None:
        raise CirlError("nothing to compare in: give a training run or a network")
    if len(set(controllers)) != len(controllers):
        raise CirlError(f"controllers {list(controllers)} must be distinct")
    if futures is not None and "scenario_mpc" not in controllers:
        raise CirlError(f"futures {futures}: only scenario_mpc plans for them, which is not among the controllers")
    if at_most and not set(controllers) & set(WITH_AIMS):
        raise CirlError(f"at_most: none of {list(controllers)} keeps budgets; add one of {', '.join(WITH_AIMS)}")
    envs = [run.make_env(1, uncertain=uncertain) for run in runs]
    draws = bool(uncertain) if not envs else envs[0].uncertain
    first = envs[0] if network is None else MultiAgentVectorEnv(network, num_envs=1, uncertain=draws)
    if envs and envs[0].network.name == first.network.name:
        first = MultiAgentVectorEnv(first.network, num_envs=1, agents=envs[0].agents, uncertain=draws)
    for run, env in zip(runs, envs, strict=True):
        reference = "the network given" if network is not None else str(runs[0].path)
        if mismatches := list(differences(env, first)):
            raise RunError(f"{run.path}: not the same environment as {reference}: {'; '.join(mismatches)}")

    def common_env(copies: int) -> MultiAgentVectorEnv:
        if network is None:
            return runs[0].make_env(copies, uncertain=uncertain)
        return MultiAgentVectorEnv(network, num_envs=copies, agents=first.agents, uncertain=draws)

    plain = [
        _controller(name, common_env, min_service, futures if name == "scenario_mpc" else None, prices, at_most)
        for name in controllers
    ]
    return [*_policies(runs, uncertain), *plain], first


def differences(env: MultiAgentVectorEnv, reference_env: MultiAgentVectorEnv) -> Iterator[str]:
    """Yield what makes an episode of ``env`` another than one of ``reference_env``.

    Observations and rewards do not count.
    """
    own_network, reference_network = env.network, reference_env.network
    if own_network.name != reference_network.name:
        yield f"network '{own_network.name}', not '{reference_network.name}'"
        return
    if env.agents != reference_env.agents:
        yield f"agents {list(env.agents)}, not {list(reference_env.agents)}"
    if env.uncertain != reference_env.uncertain:
        words = ("drawn", "not drawn") if env.uncertain else ("not drawn", "drawn")
        yield f"uncertain numbers {words[0]}, there {words[1]}; say which with uncertain"
    physics, reference = _physics(own_network), _physics(reference_network)
    changes = [f"{key} {physics[key]!r}, not {reference[key]!r}" for key in physics if physics[key] != reference[key]]
    parts, counterparts = (_parts(each.network, each.uncertain) for each in (env, reference_env))
    ids = [f"'{key[1]}'" for key in parts | counterparts if parts.get(key) != counterparts.get(key)]
    if ids:
        changes.append(f"the definition of {', '.join(ids[:5])}{' and others' if len(ids) > 5 else ''}")
    if changes and own_network.scenario_name != reference_network.scenario_name:
        yield f"scenario '{own_network.scenario_name}', not '{reference_network.scenario_name}'"
    else:
        yield from changes


def _physics(network: Network) -> dict[str, Any]:
    objective = network.objective
    return {
        "horizon": network.episode.horizon,
        "episode": replace(network.episode, horizon=1),
        "reference interval": objective.reference_interval,
        "net_zero": objective.net_zero,
        "units": (network.mass_unit, network.time_unit),
    }


def _parts(network: Network, draws_numbers: bool) -> dict[tuple[str, str], object]:
    """Return compartments, services, which may share ids, and what is uncertain, by what they are and their id."""
    parts: dict[tuple[str, str], object] = {("compartment", id_): part for id_, part in network.compartments.items()}
    parts |= {("service", service.id): service for service in network.services}
    seen_alike = {"observed": "now", "delayed": 0, "forecast": 0, "observed_by": ()}
    for path, effect in network.disturbed.items():
        parts["disturbance", path] = effect, replace(network.disturbances[effect.by], **seen_alike)
    if draws_numbers:
        parts |= {("number", path): spread for path, spread in network.uncertain.items()}
    return parts | {("correlation", "disturbance_correlation"): network.correlation}


def _policies(runs: Sequence[RunDirectory], uncertain: bool | None) -> Iterator[Contender]:
    """Yield the policies; runs that differ in their seed alone have one name, and one that is not complete its own."""
    names: dict[str, str] = {}
    runs_by_seed: dict[tuple[str, int], RunDirectory] = {}
    for run in runs:
        config = run.config
        plain = config.model_dump(mode="json")
        status = run.status
        settings = repr([plain[field] for field in ("recipe", "steps", "envs", "options")])
        name = config.recipe.name
        if status["state"] != "complete":
            name += f", {status['state']} after {status['joint_steps'] * config.envs:,} of {config.steps:,} steps"
            settings += str(run.path)
        if settings not in names:
            names[settings] = f"{name} ({run.path})" if name in (*names.values(), *CONTROLLERS) else name
        twin = runs_by_seed.setdefault((settings, config.seed), run)
        if twin is not run:
            raise RunError(f"{run.path}: the same recipe and seed {config.seed} as {twin.path}; give one of them")
        env = partial(run.make_env, uncertain=uncertain)
        yield Contender(names[settings], config.seed, run, partial(_policy, run), env)


def _policy(run: RunDirectory) -> Controller:
    from cirl_marl.learners.interface import Trained  # it needs torch

    return Trained(run)


def _controller(
    name: str,
    env: Callable[[int], MultiAgentVectorEnv],
    min_service: ArrayLike | None,
    futures: int | None,
    prices: Prices | None,
    at_most: Mapping[str, float] | None,
) -> Contender:
    service, budgets = min_service if name in PLANNERS else None, at_most if name in WITH_AIMS else None
    # an unknown name fails here, before anything is computed
    controller = controllers_by_margin(name, min_service=service, futures=futures, prices=prices, at_most=budgets)
    return Contender(name, None, None, controller, env, name in TUNABLE, bool(budgets))
