"""Open-loop optimal control: a plan for the whole episode, carried out whatever happens."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Arrays, Planner
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.network import Network
from cirl_marl.network.elements import CIRCULARITY
from cirl_marl.network.uncertainty import expected_network
from cirl_marl.optimum.admissible import NoCertificate
from cirl_marl.optimum.aims import Aim
from cirl_marl.optimum.bounds import Bound, bound
from cirl_marl.optimum.closing import close_gap
from cirl_marl.optimum.cross_entropy import Incumbent, search_each
from cirl_marl.optimum.improve import improve_plan
from cirl_marl.optimum.options import check_margin
from cirl_marl.optimum.planned_episodes import Plan, starting_states
from cirl_marl.optimum.smooth import MOST_ROWS, program_rows, smooth_plan

BOUND = 0.3
"""About the share of solving for the bound in the work on a plan; the rest is to improve it."""


class Optimum(Planner):
    """Open-loop optimal control: once started, every copy has a plan of its own for the whole episode.

    Attributes:
        plans: once started, whose plan each copy carries out: bounds, or incumbents where nothing is proved.
        note: empty if the plans are those of bounds.
    """

    ahead = 0.99

    def __init__(
        self,
        *,
        min_service: ArrayLike | None = None,
        service_weight: float | None = None,
        aim: Aim = CIRCULARITY,
        at_most: Mapping[str, float] | None = None,
        smooth: bool | None = False,
        gap: float | None = None,
    ) -> None:
        """Choose the objective; see ``bound``.

        Args:
            min_service: see ``bound``.
            service_weight: likewise.
            aim: likewise.
            at_most: likewise.
            smooth: whether ``smooth_plan`` has the last word; None: where ``program_rows`` is at most MOST_ROWS.
            gap: to the bound that is enough (``close_gap``), beside a demanded service; None: one program is solved,
                and its plan improved as far as it can be.

        Raises:
            CirlError: for a gap that is not positive, or beside a weight of services.
        """
        if gap is not None:
            check_margin(gap, "gap")
            if service_weight is not None:
                raise CirlError(f"gap {gap:g} is to a bound with a demanded service: give min_service")
        self._gap = gap
        self._min_service, self._service_weight, self._smooth = min_service, service_weight, smooth
        self._aims: dict[str, Any] = {"aim": aim, "at_most": at_most}
        self.plans: list[Bound] | list[Incumbent] = []
        self._plan = Plan(())

    def plan(self, env: MultiAgentVectorEnv, seed: int, progress: Callable[[float], None]) -> None:
        """Solve a program for the start of every copy and improve its plan; ``seed`` has no effect.

        Where no program bounds the network (``NoCertificate``), look for plans by simulation, from all starts at once.

        Raises:
            CirlError: for a service that no plan reaches, a solver that fails, or an environment in which nobody acts.
        """
        try:
            network, notes = expected_network(env.network), []
            if env.network.disturbed:
                notes.append("plans for what disturbances are expected to be, carried out whatever they are")
            is_small = (rows := program_rows(network)) <= MOST_ROWS
            if self._smooth is None and not is_small:
                notes.append(f"not made smooth: that program has {rows:,} rows; beyond {MOST_ROWS:,} ask for it")
            smooth = is_small if self._smooth is None else self._smooth
            self.plans, self.note = self._bound_plans(env, network, smooth, progress), "; ".join(notes)
        except NoCertificate as reason:
            if self._gap is not None or self._aims["aim"] != CIRCULARITY or self._aims["at_most"]:
                raise  # what is searched for is λ̄, and proves nothing
            self.plans = self._search_plans(env, progress)
            self.note = f"best plan found, no certificate: {reason}"
        self._plan = Plan(self.plans)
        self._plan.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return the planned actions of the next interval."""
        return self._plan.act(observations)

    def _bound_plans(
        self, env: MultiAgentVectorEnv, network: Network, smooth: bool, progress: Callable[[float], None]
    ) -> list[Bound]:
        plans: list[Bound] = []
        by_start: dict[bytes, Bound] = {}  # copies that start alike have the same plan, though their draws differ
        for copy, start in enumerate(env.physical.stock[env.rows.nodes].T):

            def report(improvement: float, copy: int = copy) -> None:
                progress((copy + BOUND + (1 - BOUND) * improvement) / env.num_envs)

            if (key := start.tobytes()) in by_start:
                plans.append(by_start[key])
                report(1.0)
                continue
            options = {"min_service": self._min_service, "agents": env.agents or None, **self._aims}
            if self._gap is None:
                solution = bound(network, start, service_weight=self._service_weight, **options)
                report(0.0)
                plan = improve_plan(solution, progress=report)
            else:
                plan = close_gap(network, within=self._gap, initial=start, **options).bound
                report(1.0)
            plans.append(replace(smooth_plan(plan) if smooth else plan, network=env.network))
            by_start[key] = plans[-1]
        return plans

    def _search_plans(self, env: MultiAgentVectorEnv, progress: Callable[[float], None]) -> list[Incumbent]:
        incumbents = search_each(
            expected_network(env.network),
            starting_states(env),
            min_service=self._min_service,
            service_weight=self._service_weight,
            agents=env.agents or None,
            progress=lambda share, objective: progress(share),
        )
        return [replace(incumbent, network=env.network) for incumbent in incumbents]
