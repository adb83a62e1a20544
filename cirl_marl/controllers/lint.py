"""What is no mistake in a network but seldom meant."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial

import numpy as np

from cirl_marl.controllers.basic import Constant, Neutral
from cirl_marl.controllers.outcome import NOTABLE, service_shortages, shortages
from cirl_marl.controllers.rollout import Rollout, episode_start
from cirl_marl.dynamics.laws import LAWS
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Network
from cirl_marl.network.compartment_model import ReleasingModel
from cirl_marl.network.elements import Arc, ControlKind, Law, Role
from cirl_marl.network.lifetimes import CLOSE
from cirl_marl.network.series import Series, extremes
from cirl_marl.network.units import factor
from cirl_marl.network.validation.settings import is_whole

OWN_DEMANDS = (
    "for products with demands of their own let it share out what is recycled, and primary material enter behind it, "
    "by an arc for each that makes up for its service (docs/yearly_networks.md)"
)
COARSE = 0.01
"""Share of its largest value by which a state may depend on the step of the solver."""

INTERVALS = 200
"""Control intervals over which this is looked at."""

SHORT = 20
"""Control intervals over which the ends of the controls are tried."""


def lint_warnings(network: Network, env: MultiAgentVectorEnv | None = None) -> Iterator[str]:
    """Yield what whoever wrote ``network`` may not have meant: what is idle, starved, too late or too coarse.

    ``env`` is one copy of it; None makes one.
    """
    env = MultiAgentVectorEnv(network, num_envs=1) if env is None else env
    for look in (_apart, _without_effect, _shares, _departures, _free, _markets):
        yield from look(network)
    neutral = cache(partial(episode_start(env).play, env, Neutral()))
    yield from _short_flows(env, neutral)
    yield from _short_services(env, neutral)
    for look in (_aimless, _unpaid):
        yield from look(network)
    yield from _coarse(env)
    yield from _lives(network)


def _apart(network: Network) -> Iterator[str]:
    """Yield nodes that no arc touches and that have nothing else to do, and those without stock that get nothing."""
    recipients = {arc.recipient for arc in network.arcs}
    connected = recipients | {arc.donor for arc in network.arcs}
    for node in network.nodes:
        if node.model is None and node.id not in connected:
            yield f"node '{node.id}': no arc begins or ends here, so that no mass enters or leaves it"
        elif not node.stores and node.id not in recipients:
            yield f"node '{node.id}': it stores nothing and nothing enters it, so that nothing ever leaves it"


def _without_effect(network: Network) -> Iterator[str]:
    """Yield valves and pollutants that change nothing."""
    donors = {arc.donor for arc in network.arcs if arc.law is not Law.BATCH}
    for node in network.nodes:
        if node.control is not None and node.control.kind is ControlKind.RATE and node.id not in donors:
            yield f"node '{node.id}': its valve scales no flow, as nothing but batches leaves it"
    for arc in network.arcs:
        recipient = network.nodes[network.node_index[arc.recipient]]
        if not arc.pollutant and recipient.role is not Role.ENVIRONMENT:
            yield f"arc '{arc.id}': pollutant = false says nothing here, as '{arc.recipient}' is no environment"


def _shares(network: Network) -> Iterator[str]:
    """Yield valves that are easily taken for shares: on one arc of a donor whose other proportional flows have none.

    A valve v on a flow whose share is s at v = 1 makes it the share v·s/(1 + (v − 1)·s), not v·s. Where every flow has
    a valve, they set what passes, and no share is meant.
    """
    exits: dict[str, list[Arc]] = {}
    for arc in network.arcs:
        if arc.law is Law.DONOR:
            exits.setdefault(arc.donor, []).append(arc)
    for node in network.nodes:
        split = exits.get(node.id, [])
        rates = {arc.id: float(network.interval_means(arc.rate)[0]) for arc in split}
        valves = [(arc, arc.control) for arc in split if arc.control is not None]
        for arc, control in valves if len(valves) < sum(rate > 0 for rate in rates.values()) else ():
            share = rates[arc.id] / sum(rates.values())
            ends = [
                (v * share / (1 + (v - 1) * share), v, end)
                for v, end in ((extremes(control.low)[0], "lowest"), (extremes(control.high)[1], "highest"))
            ]
            passing_share, valve, end = max(ends, key=lambda candidate: abs(candidate[1] * share - candidate[0]))
            if abs(valve * share - passing_share) > COARSE:
                part = f"{passing_share:.0%} of what leaves '{node.id}' in proportion to its stock"
                comparison = f"not {valve * share:.0%}: {valve:.3g} × {share:.0%}"
                remedy = 'law = "share" with control.kind = "share" sets a share itself'
                yield f"arc '{arc.id}': at its {end} its valve lets through {part}, {comparison}; {remedy}"


def _departures(network: Network) -> Iterator[str]:
    """Yield series and batches that begin after the episode, and batches that a station cannot finish."""
    interval, horizon = network.episode.control_interval, network.episode.horizon
    end = f"an episode ends at {horizon * interval:g} {network.time_unit}"
    for arc in network.arcs:
        times = arc.flow.times if isinstance(arc.flow, Series) else ()
        if len(times) > 1 and times[1] >= horizon * interval:
            yield f"arc '{arc.id}': series: {end}, so that what begins at {times[1]:g} {network.time_unit} never comes"
        recipient = network.nodes[network.node_index[arc.recipient]]
        batch_kg = recipient.model.batch_kg if isinstance(recipient.model, ReleasingModel) else None
        for time, mass in arc.batches:
            at = f"arc '{arc.id}': batch at {time:g} {network.time_unit}"
            if round(time / interval) >= horizon:
                yield f"{at}: {end}, so that it never leaves"
            if batch_kg is not None and not is_whole(mass * factor(network.mass_unit, "kg") / batch_kg):
                sizes = f"batches of {batch_kg:g} kg, as '{recipient.id}' makes them, so that a part of it waits there"
                yield f"{at}: {mass:g} {network.mass_unit} are no whole number of {sizes}"


def _coarse(env: MultiAgentVectorEnv) -> Iterator[str]:
    """Yield what neutral control brings about otherwise with half the solver's step, and controls it cannot follow."""
    network, step = env.network, env.network.episode.solver_step
    if step is None or network.episode.solver == "exact":
        return
    try:
        for action in (-1.0, 1.0):
            _states(env, action, SHORT)
        finer = MultiAgentVectorEnv(network.with_options(episode={"solver_step": step / 2}), num_envs=1)
        trajectories = [_states(variant, None, INTERVALS) for variant in (env, finer)]
    except CirlError as error:
        yield str(error)
        return
    size = np.maximum(np.abs(trajectories[1]).max(axis=0), 1e-9)
    apart = np.abs(trajectories[0] - trajectories[1]).max(axis=0) / size
    if apart[worst := int(apart.argmax())] > COARSE:
        name = env.state_names[worst]
        change = f"neutral control gives another {name}, by {apart[worst]:.0%} of its largest value; take a shorter one"
        yield f"episode.solver_step {step:g} {network.time_unit} is long: with half of it, {change}"


def _lives(network: Network) -> Iterator[str]:
    """Yield lifetimes that stages follow less closely than others."""
    for node in network.stores:
        chain = None if node.lifetime is None else node.lifetime.chain
        if node.lifetime is not None and chain is not None and chain.error > CLOSE:
            yield (
                f"node '{node.id}': lifetime: {chain.stages} stages follow the survival function of this "
                f"{node.lifetime.distribution} lifetime of {node.lifetime.mean:g} ± {node.lifetime.deviation:g} "
                f"{network.time_unit} within {chain.error:.1%}; most others are followed within {CLOSE:.1%}"
            )


def _states(env: MultiAgentVectorEnv, action: float | None, intervals: int) -> Floats:
    """Return the states that come of one action of all agents, None being neutral, shape (intervals, states)."""
    env.reset(seed=0)
    controls = env.dynamics.neutral.copy()
    if action is not None:
        rows = [row for agent in env.agents for row in range(len(controls))[env.network.control_rows[agent]]]
        controls[rows] = (env.dynamics.control_low if action < 0 else env.dynamics.control_high)[rows]
    state, trajectory = env.physical, []
    with np.errstate(all="ignore"):
        for step in range(min(env.network.episode.horizon, intervals)):
            after = env.dynamics.advance(state.stock, state.inner, controls[:, [step]], np.array([step]))
            state = replace(state, stock=after.stock, inner=after.inner)
            whole = env.rows.start_of(after.stock, after.inner)
            trajectory.append(np.concatenate([whole[:, 0], after.stock[env.rows.batches, 0]]))
    return np.array(trajectory)


def _free(network: Network) -> Iterator[str]:
    """Yield nodes of the technosphere that give what never came in, other than by physics of their own."""
    recipients, donors = ({getattr(arc, end) for arc in network.arcs} for end in ("recipient", "donor"))
    for node, most in zip(network.stores, network.initial[1], strict=True):
        is_free = node.id in donors - recipients and most > 0 and node.model is None
        if is_free and node.role is Role.TECHNOSPHERE:
            remedy = "if it stands for mining or for imports of primary material, its role is nonrenewable_reservoir"
            yield f"node '{node.id}': nothing enters it, and what it delivers counts nothing in λ; {remedy}"


def _markets(network: Network) -> Iterator[str]:
    """Yield stores that stand where a market would, so that each of several products gets what it asks for."""
    recipients = {arc.recipient for arc in network.arcs}
    for node in network.stores:
        exits = [arc for arc in network.arcs if arc.donor == node.id]
        orders = [arc for arc in exits if arc.law is Law.CONTROLLED]
        if node.role is Role.TECHNOSPHERE and node.id in recipients and orders == exits and len(exits) > 1:
            reason = f"a stock from which {', '.join(arc.id for arc in exits)} take what they ask for"
            yield f"node '{node.id}': {reason}; if it is a market: stores = false, and a share for the rest"


def _short_flows(env: MultiAgentVectorEnv, neutral: Callable[[], Rollout]) -> Iterator[str]:
    """Yield scheduled flows that run short: under neutral control, and from sources whose controls are at the highest.

    A source is a donor that nothing enters. That agents, or what nobody foresees, can empty others is no fault of the
    network.
    """
    network = env.network
    scheduled_donors = {arc.id: arc.donor for arc in network.arcs if LAWS[arc.law].is_scheduled}
    if not scheduled_donors:
        return
    if network.episode.horizon > INTERVALS:
        env = MultiAgentVectorEnv(network, num_envs=1, horizon=INTERVALS)
        neutral = partial(episode_start(env).play, env, Neutral())
    recipients = {arc.recipient for arc in network.arcs}
    sources = {id_ for arc, donor in scheduled_donors.items() if donor not in recipients for id_ in (arc, donor)}
    highest = {agent: 1.0 for agent in network.agents if agent in sources and _scales(network, agent)}
    reported: set[str] = set()
    checks = [("neutral", neutral, sources if network.disturbed else set(scheduled_donors))]
    if highest:
        checks.append(("the highest", partial(episode_start(env).play, env, Constant(highest)), sources))
    for control, run, looked_at in checks:
        try:
            shortages_ = list(shortages(run(), env.network))
        except CirlError as error:
            yield str(error)
            return
        for short in shortages_:
            arc, since = short.arc, f"from {short.begins:g} {network.time_unit} on"
            if arc.id in looked_at - reported:
                reported.add(arc.id)
                stores = network.nodes[network.node_index[arc.donor]].stores
                verb, remedy = "gets", "let more enter it, or order less"
                if stores:
                    verb, remedy = "holds", "give it a larger initial stock if it stands for the world outside"
                little = f"under {control} control '{arc.donor}' {verb} too little for its flow {since}"
                yield f"arc '{arc.id}': {little}; {remedy}"


def _short_services(env: MultiAgentVectorEnv, neutral: Callable[[], Rollout]) -> Iterator[str]:
    """Yield services that fall short of what is demanded though arcs make up for them."""
    if not any(arc.makes_up_for for arc in env.network.arcs):
        return
    for shortage in service_shortages(neutral(), env.network):
        yield f"under neutral control {shortage}; widen the bounds of its control, or ask for less"
    supplied = {arc.makes_up_for for arc in env.network.arcs}
    for service, level in zip(env.network.services, neutral().episode_levels[0].tolist(), strict=True):
        if service.id not in supplied and level < 1 - NOTABLE:
            lacks = (
                f"service '{service.id}': under neutral control its level is {level:.3f}, and nothing makes up for it"
            )
            yield f"{lacks}, as for others. If a market shares out to several: {OWN_DEMANDS}"


def _scales(network: Network, id_: str) -> bool:
    """Whether the control of a compartment sets or scales flows."""
    control = network.compartments[id_].control
    return control is not None and control.kind is not ControlKind.INPUT


def _aimless(network: Network) -> Iterator[str]:
    """Yield the lack of a service where agents are paid for λ, which is best when nothing flows, and a λ that is 0."""
    if _paid_for_circularity(network) and network.arcs and not network.sustainability.any():
        roles = ", ".join(sorted({node.role.value for node in network.nodes}))
        yield f"λ is always 0, as no arc leaves a reservoir or enters a sink: the roles are {roles}"
    if _paid_for_circularity(network) and not network.services:
        reward = network.objective.reward
        yield f"there is no service, so that agents with reward '{reward}' do best to stop whatever flows"


def _unpaid(network: Network) -> Iterator[str]:
    """Yield services whose shortfall nobody who acts feels.

    A shortfall lowers the local reward of those who owe the service. If none of them acts, or some do not, agents that
    are paid for λ too are paid for stopping what the service is there to keep up.
    """
    if not _paid_for_circularity(network):
        return
    for service in network.services:
        idle = [debtor for debtor in service.debtors if debtor not in network.agents]
        debt = "owed_by" if service.owed_by else "owed_by is left out, so the provider owes it;"
        if len(idle) == len(service.debtors):
            unpaid = f"no agent is paid less when the service fails; agents are {', '.join(network.agents)}"
            yield f"service '{service.id}': {debt} {', '.join(idle)}: does not act, so that {unpaid}"
        elif idle:
            yield f"service '{service.id}': owed_by: {', '.join(idle)} does not act and cannot be paid less"


def _paid_for_circularity(network: Network) -> bool:
    return bool(network.agents) and not network.objective.reward.startswith("local")
