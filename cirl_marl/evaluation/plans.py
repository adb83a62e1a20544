"""Plans: what the policies of a run or a controller do in one episode, beside the same episode without them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers import Controller
from cirl_marl.controllers.schedule import Schedule, schedule
from cirl_marl.definitions.catalogue import file_and_region, networks
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, path_of
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network import Network
from cirl_marl.network.elements import CIRCULARITY
from cirl_marl.optimum.aims import Aim, aims_of, budget_texts
from cirl_marl.optimum.bounds import Bound, bound, gap
from cirl_marl.optimum.open_loop import Optimum
from cirl_marl.optimum.options import lack_texts, levels_text
from cirl_marl.optimum.registry import CONTROLLERS, named_controller
from cirl_marl.optimum.solver import SolverFailure

LOOSE, TOLERANCE = 0.05, 1e-6
"""Gap beyond which a bound on λ̄ and service together says little of λ̄, and level within which a solver is exact."""


def plan(
    source: str | Path | Network | RunDirectory,
    control: str | Controller | None = None,
    *,
    scenario: str | None = None,
    min_service: ArrayLike | None = None,
    seed: int | None = None,
    smooth: bool | None = None,
    gap: float | None = None,
    aim: Aim = CIRCULARITY,
    at_most: Mapping[str, float] | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Schedule:
    """Return what a policy or controller does in one episode, beside business as usual.

    >>> import cirl_marl
    >>> found = cirl_marl.plan("net_zero", "scripted")
    >>> found.header[:2], found.columns.shape[1]
    (('from (day)', 'to (day)'), 120)

    Args:
        source: directory of a training run, whose policies act; or catalogue name, definition file or network.
        control: who acts in a network: a name of CONTROLLERS, or a controller; None for a run.
        scenario: of the definition; None is the default, physical one.
        min_service: mean level of every service, or of each, shape (services,), that ``mpc`` and ``optimum`` plan for,
            a share in [0, 1]; None: as much as can be had.
        seed: of the evaluation whose first episode is planned; None begins in the middle of all initial ranges.
        smooth: whether a plan of ``optimum`` is the one nearest to business as usual, with the least change from
            interval to interval, among those of the same λ̄ and services (``optimum.smooth``); None: unless the
            network is large. Of other controllers, and where nothing is proved, plans stay as they are.
        gap: to the bound, relative to it, that is enough for a plan of ``optimum`` beside ``min_service``; for it
            tighter bounds are proved (``close_gap``). None: one bound, and the best plan that is found.
        aim: of ``mpc`` and ``optimum``: ``circularity``, the account to keep as low as can be beside ``min_service``,
            or weights of these; see ``bound``.
        at_most: of these: budgets, the highest total of accounts by id, in their units; see ``bound``.
        progress: called with the share of the work that is done.

    Returns:
        The table of all controls, flows, λ and service level, a row for each control interval; ``write`` makes it a
        CSV file.

    Raises:
        CirlError: for input that cannot be used, a controller that does not fit the network, or a solver that fails.
        RunError: if the run is incomplete.
    """
    if smooth is not None and control != "optimum":
        raise CirlError("--smooth and --no-smooth go with --control optimum")
    if gap is not None and (control != "optimum" or min_service is None):
        raise CirlError(f"--gap {gap:g} goes with --control optimum and --min-service")
    options = {"min_service": min_service, "smooth": smooth, "gap": gap, "aim": aim, "at_most": at_most}
    env, controller = _environment_and_controller(source, control, scenario, options)
    table = schedule(env, controller, seed=seed, progress=progress)
    name = type(control).__name__ if isinstance(control, Controller) else control or ""
    return replace(table, control=name, note=controller.note, proof=_proof(controller, table))


def _proof(controller: Controller, table: Schedule) -> str:
    """Say what λ̄ no episode with this service exceeds, and how far the plan stays below; empty where nothing does.

    Of λ̄/scale + w·service ≤ β follows λ̄ ≤ scale·(β − w·service) for all that serve as much; where the network cannot
    serve as its relaxation does that says little, and a bound at this service is solved. Of a disturbed network the
    program is that of what is expected, which bounds no episode.
    """
    if table.network.disturbed:
        return ""
    if not isinstance(controller, Optimum) or not isinstance(solution := controller.plans[0], Bound):
        return ""
    network, run, limit, demand = table.network, table.rollout, solution.objective, "any service"
    aims = solution.aims
    if solution.service_weight is not None:
        limit -= solution.service_weight * float(run.episode_service[0])
        limit, demand = limit * network.objective.circularity_scale, "this service"
        if gap(limit, aims.value(run)) > LOOSE:
            levels = np.maximum(run.episode_levels[0] - TOLERANCE, 0.0)
            with suppress(SolverFailure):  # the first bound holds as well
                at_service = bound(network, solution.initial, min_service=levels, agents=solution.agents or None)
                limit = min(limit, at_service.objective)
    elif solution.min_service is not None:
        demand = f"a service of at least {levels_text(network, solution.min_service)}"
    unit = "λ̄/scale" if solution.service_weight is not None else aims.unit(network)
    prices = solution.budget_prices
    for text, names in budget_texts(network, aims):
        dearest = max(names, key=prices.__getitem__)
        worth = f"{prices[dearest]:.4g} {unit}".rstrip() + (f" of {dearest}, no more in others" if names[1:] else "")
        demand += f", {text} (one more is worth {worth})"
    proof = f"bound with {demand}: {aims.statement(network, limit, 5)}, gap {float(gap(limit, aims.value(run))):.2%}"
    faults = [] if solution.min_service is None else lack_texts(network, solution.min_service, run.episode_levels[0])
    return f"{proof}; no plan was found that keeps services; this one has {', '.join(faults)}" if faults else proof


def _environment_and_controller(
    source: str | Path | Network | RunDirectory,
    control: str | Controller | None,
    scenario: str | None,
    options: Mapping[str, Any],
) -> tuple[MultiAgentVectorEnv, Controller]:
    run = _run_of(source)
    if control is not None:
        if isinstance(source, RunDirectory) or (run is not None and (run.path / "config.json").is_file()):
            raise CirlError(f"plan {source}: is a training run, which acts by its policies; leave out --control")
        env = MultiAgentVectorEnv(source, num_envs=1, scenario=scenario)
        if isinstance(control, str):
            aims_of(env.network, options["aim"], options["at_most"], with_services=True)  # names what is unknown first
            control = named_controller(control, **options)
        return env, control
    if run is None:
        name = source.name if isinstance(source, Network) else source
        raise CirlError(f"plan {name}: which control? --control {'|'.join(CONTROLLERS)}; only a run has policies")
    if scenario is not None or options["min_service"] is not None:
        raise CirlError("--scenario and --min-service go with --control; a run has its own scenario and policies")
    from cirl_marl.learners.interface import Trained  # it needs torch

    return run.make_env(1), Trained(run)


def _run_of(source: str | Path | Network | RunDirectory) -> RunDirectory | None:
    """Return the training run that a source names, whether or not it is there; None for a network."""
    if isinstance(source, Network | RunDirectory):
        return source if isinstance(source, RunDirectory) else None
    if (path_of("source", source) / "config.json").is_file():
        return RunDirectory(source)
    return None if str(source) in networks() or file_and_region(str(source)) else RunDirectory(source)
