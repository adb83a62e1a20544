"""What tests share: random networks (``st.from_type(Network)``), short trainings, and which parameters are sampled."""

from __future__ import annotations

import gc
import math
import os
import random
import shutil
import signal
from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from cirl_marl import (
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    Network,
    Node,
    Objective,
    Role,
    Series,
    Service,
    Substance,
)
from cirl_marl.definitions.reader import Definition
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.network.elements import FIXED_LIFETIME, Lifetime
from cirl_marl.network.lifetimes import SURVIVALS

if TYPE_CHECKING:
    from cirl_marl.learners.recipe import Recipe
    from cirl_marl.learners.trainer import Progress

settings.register_profile(
    "cirl_marl",
    deadline=None,
    database=None,
    max_examples=12,
    derandomize="CI" in os.environ,
    suppress_health_check=[HealthCheck.too_slow],
)

settings.register_profile("all", settings.get_profile("cirl_marl"), max_examples=75)
settings.register_profile("thorough", settings.get_profile("cirl_marl"), max_examples=1000, derandomize=False)
settings.load_profile("cirl_marl")

GUIDE = Path(__file__).parent.parent / "envs" / "README.md"
ROLES = list(Role)
LAWS = [law for law in Law if law not in (Law.COMPARTMENT, Law.SHARE)]
SEED = "CIRL_TEST_SEED"


def pytest_configure() -> None:
    """Settle the seed of what is sampled, before the workers of pytest-xdist start and inherit it."""
    os.environ.setdefault(SEED, "0" if "CI" in os.environ else str(random.SystemRandom().randrange(10**6)))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of a test marked ``sample(count)`` draw so many of its parameters; the others are ``slow``."""
    roaming = defaultdict(list)
    for item in items:
        if item.get_closest_marker("sample"):
            roaming[item.nodeid.partition("[")[0]].append(item)
    for name, variants in roaming.items():
        (count,) = next(variants[0].iter_markers("sample")).args
        kept = random.Random(f"{os.environ[SEED]} {name}").sample(variants, min(count, len(variants)))
        for item in variants:
            if item not in kept:
                item.add_marker("slow")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect no garbage while thousands of tests are collected, a quarter of that time, nor these later on."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the seed, which repeats the sample, and what had to be left out for want of something on this machine."""
    terminalreporter.write_line(f"{SEED}={os.environ[SEED]} drew the parameters of tests marked 'sample'")
    missing = Counter(
        str(report.longrepr[2]).removeprefix("Skipped: ")
        for report in terminalreporter.getreports("skipped")
        if isinstance(report.longrepr, tuple)
    )
    for reason, count in missing.items():
        terminalreporter.write_line(f"left out {count} test{'s' if count > 1 else ''}: {reason}")


@pytest.fixture(scope="session")
def bottles(tmp_path_factory: pytest.TempPathFactory) -> Network:
    """Return the small network of the guide, for a fortnight."""
    text = GUIDE.read_text().split("```toml\n")[1].split("```")[0]
    path = tmp_path_factory.mktemp("definition") / "bottles.toml"
    path.write_text(text.replace("horizon = { value = 60", "horizon = { value = 14"))
    return Definition(path).network()


@pytest.fixture
def make_network() -> Callable[[int, int, int], Network]:
    """``random_network``, for tests of one that once failed."""
    return random_network


@pytest.fixture
def ctrl_c_after() -> Callable[..., Callable[[Progress], None]]:
    """Return ``ctrl_c_after(env_steps, signal)``, which is to be reported to by ``train`` and then interrupts it."""

    def reports_to(env_steps: int, which: int = signal.SIGINT) -> Callable[[Progress], None]:
        def report(progress: Progress) -> None:
            if progress.env_steps == env_steps:
                os.kill(os.getpid(), which)

        return report

    return reports_to


def few_rollouts() -> Recipe:
    """Return a recipe for a few rollouts of PPO in two copies."""
    from cirl_marl.learners.recipe import LearnerSettings, Recipe, Run

    parameters = {"n_steps": 10, "batch_size": 20, "n_epochs": 2, "policy_kwargs": {"net_arch": [8]}}
    learner = LearnerSettings(algorithm="PPO", parameters=parameters)
    return Recipe(
        name="small", title="small", run=Run(steps=80, envs=2, engine="lockstep", evaluations=0), learner=learner
    )


@pytest.fixture(scope="module", autouse=True)
def coarse_pictures() -> Iterator[None]:
    """Write pictures with a quarter of the dots per inch: they take most of the time of the tests that draw."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cirl_marl.drawing.style.DPI", 50)
        yield


@pytest.fixture
def ppo_recipe() -> Recipe:
    """Return a recipe for a few rollouts of PPO in two copies."""
    return few_rollouts()


@pytest.fixture(scope="session")
def copper_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run of ``ppo_recipe`` in ``copper_net``, in episodes of five steps, that tests only read."""
    from cirl_marl.learners.interface import train

    directory = tmp_path_factory.mktemp("copper") / "run"
    train("copper_net", few_rollouts(), directory=directory, horizon=5)
    return directory


@pytest.fixture
def own_copper_run(copper_run: Path, tmp_path: Path) -> Path:
    """Return a copy of ``copper_run``, ``tmp_path / "run"``, that a test may change."""
    return shutil.copytree(copper_run, tmp_path / "run")


def random_network(seed: int, nodes: int, arcs: int, *, runge_kutta: bool = False, lifetimes: bool = False) -> Network:
    """Return a network with every law, role and kind of control, drawn from ``seed``; half have shares and series.

    With ``lifetimes`` some nodes have one, in networks that are otherwise the same.
    """
    rng = np.random.default_rng(seed)
    ends = [rng.choice(nodes, 2, replace=False) for _ in range(arcs if nodes > 1 else 0)]
    laws: list[Law] = [LAWS[rng.integers(len(LAWS))] for _ in ends]
    interval, horizon = float(rng.uniform(0.05, 3)), int(rng.integers(1, 5))
    real = bool(rng.integers(2))
    passing = {i for i in range(1, nodes) if real and rng.random() < 0.4}
    dividing = passing | {i for i in range(nodes) if real and nodes > len(passing) + 1 and rng.random() < 0.2}
    further = np.random.default_rng([seed, 1])
    living = {i for i in range(1, nodes) if lifetimes and real and nodes > len(passing) + 1 and further.random() < 0.4}
    living -= passing
    dividing |= living
    for k, (i, j) in enumerate(ends):
        if int(i) in living:
            laws[k] = Law.SHARE
        elif int(j) in living and laws[k] in (Law.BATCH, Law.RECIPIENT):
            laws[k] = Law.DONOR
        if laws[k] in (Law.BATCH, Law.RECIPIENT) and {int(i), int(j)} & passing:
            laws[k] = Law.DONOR
        if int(i) in passing or (int(i) in dividing and laws[k] is Law.DONOR):
            laws[k] = Law.SHARE
    orders = np.bincount([i for (i, _), law in zip(ends, laws, strict=True) if law is Law.CONTROLLED], minlength=nodes)
    sets_flow = [bool(orders[i] == 1 and rng.random() < 0.5) and i not in passing | living for i in range(nodes)]
    batched = {f"node_{i}" for (i, _), law in zip(ends, laws, strict=True) if law is Law.BATCH}
    values = _Values(rng, interval * horizon, real)
    drawn = [
        _arc(values, k, int(i), int(j), law, sets_flow[int(i)], int(i) not in passing, interval)
        for k, ((i, j), law) in enumerate(zip(ends, laws, strict=True))
    ]
    sinks = [i for i in range(nodes) if i not in passing]
    # the rest of every split goes to a stock, so that no loop keeps what it gets
    for i in sorted(dividing):
        to = int(rng.choice([j for j in sinks if j != i]))
        drawn.append(Arc(id=f"rest_{i}", donor=f"node_{i}", recipient=f"node_{to}", law=Law.SHARE))
    if real:
        drawn = limited(drawn, [f"node_{i}" for i in range(nodes) if i not in passing], seed, interval * horizon)
    made = [_node(values, i, sets_flow[i], i not in passing, i in dividing) for i in range(nodes)]
    for i in sorted(living):
        made[i] = _living(further, made[i], interval, horizon)
    services = _services(values, nodes, len(ends), batched, passing)
    if lifetimes:
        services = [_joined(further, each, nodes, len(ends), batched, passing) for each in services]
    network = Network(
        name="random",
        nodes=tuple(made),
        arcs=tuple(drawn),
        services=tuple(services),
        episode=Episode(control_interval=interval, horizon=horizon),
        objective=Objective(
            reference_interval=float(rng.uniform(0.1, 3)),
            net_zero=str(rng.choice(["signed", "abs"])),
            circularity_scale=float(rng.uniform(1, 100)),
            circularity_weight=float(rng.random()),
        ),
    )
    if not runge_kutta:
        return network
    step = interval / Dynamics(network).substeps
    return network.with_options(episode={"solver": "rk4", "solver_step": step})


def with_substances(network: Network, seed: int, *, batches: bool = False) -> Network:
    """Return a network with one or two substances, some of which nodes separate, and limits on contents.

    What recipients draw becomes a schedule, as it does not follow substances, and so do batches unless they are kept.
    """
    rng = np.random.default_rng([seed, 3])
    names = [f"substance_{i}" for i in range(int(rng.integers(1, 3)))]
    nodes = []
    for node in network.nodes:
        parts = rng.dirichlet([1.0] * (len(names) + 1))[1:] * rng.integers(2, size=len(names))
        nodes.append(replace(node, content=dict(zip(names, parts.tolist(), strict=True)) if node.stores else {}))
    first = next(i for i, node in enumerate(nodes) if node.stores)
    nodes[first] = replace(nodes[first], content=dict.fromkeys(names, 0.3))
    rests = {arc.donor for arc in network.arcs if arc.law is Law.SHARE and arc.share is None and arc.control is None}
    arcs = []
    for arc in network.arcs:
        if arc.law is Law.RECIPIENT or (arc.law is Law.BATCH and not batches):
            flow = float(rng.uniform(0, 50))
            arc = Arc(id=arc.id, donor=arc.donor, recipient=arc.recipient, law=Law.EXOGENOUS, flow=flow)
        elif arc.law is Law.SHARE and arc.donor in rests and not (arc.share is None and arc.control is None):
            separated = [name for name in names if rng.random() < 0.4]
            if arc.control is None and separated and rng.random() < 0.3:
                low, neutral, high = np.sort(rng.uniform(0, 0.045, 3)).tolist()
                control = Control(
                    kind=ControlKind.TRANSFER, low=low, neutral=neutral, high=high, substances=tuple(separated)
                )
                arc = replace(arc, control=control)
            elif separated:
                arc = replace(arc, transfer=dict.fromkeys(separated, float(rng.uniform(0, 0.045))))
        arcs.append(arc)
    carried = {arc.id for arc in network.arcs if arc.law is Law.BATCH}
    services = [s for s in network.services if s.quantity != "stock" or carried.isdisjoint(s.providers)]
    ends = [(0.0, 1.0), (0.6, math.inf)]  # limits of a content, and grades
    services += [
        replace(s, id=f"{s.id}_content", substance=names[0], low=low * content, high=high * content)
        for s in services
        if rng.random() < 0.5
        for content in [float(rng.uniform(0.01, 0.5))]
        for low, high in [ends[int(rng.integers(2))]]
    ]
    substances = tuple(Substance(id=name, scale=0.1) for name in names)
    network = network.variant(  # some limits are out of reach
        nodes=tuple(nodes), arcs=tuple(arcs), services=tuple(services), substances=substances
    )
    return with_changing_contents(network, seed) if not batches and rng.random() < 0.5 else network


def with_changing_contents(network: Network, seed: int) -> Network:
    """Return a network with substances into which a source gives what changes in time, as histories did."""
    rng, length = np.random.default_rng([seed, 4]), network.episode.control_interval * network.episode.horizon
    names = [substance.id for substance in network.substances]

    def changing(begin: float, end: float) -> dict[str, Series]:
        times = tuple(np.linspace(begin, end, 4).tolist())
        share = 0.7 / len(names)  # one may step while another grows, and tests draw and disturb them by up to 1.37
        table = rng.dirichlet([1.0] * (len(names) + 1), 4)[:, 1:] * rng.integers(2, size=(4, 1))
        kinds = [str(rng.choice(["step", "linear"])) for _ in names]
        table[0] = 0.6 / len(names)
        return {
            name: Series(times=times, values=tuple(column.tolist()), interpolation=kind)
            for name, column, kind in zip(names, table.T * share, kinds, strict=True)
        }

    nodes = [
        node if node.history is None else replace(node, content=changing(node.history.times[0], 0.0))
        for node in network.nodes
    ]
    recipients = rng.choice([node.id for node in network.nodes], 2)
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=5.0, high=float(rng.uniform(5, 50)))
    valve = Control(kind=ControlKind.RATE, low=0.2, neutral=0.7, high=1.3)
    control = [None, valve, order][int(rng.integers(3))]  # of the source; of its flow if that is no order
    limit: dict[str, Any] = {"capacity_node": network.stores[0].id, "capacity_rate": 0.5} if rng.random() < 0.3 else {}
    arcs = (
        Arc(
            id="quarried",
            donor="quarry",
            recipient=str(recipients[0]),
            law=Law.CONTROLLED,
            control=None if control is order else order,
            **limit,
        ),
        Arc(id="dug", donor="quarry", recipient=str(recipients[1]), law=Law.EXOGENOUS, flow=float(rng.uniform(0, 20))),
    )
    quarry = Node(
        id="quarry",
        role=Role.NONRENEWABLE_RESERVOIR,
        content=changing(0.0, length),
        control=control,
    )
    return replace(network, nodes=(*nodes, quarry), arcs=(*network.arcs, *arcs), scenarios={})


def limited(arcs: list[Arc], holders: list[str], seed: int, length: float) -> list[Arc]:
    """Return arcs of which stocks limit some scheduled flows, at rates that may change in time."""
    rng, limits = np.random.default_rng([seed, 2]), []
    for arc in arcs:
        if arc.law is Law.CONTROLLED and rng.random() < 0.4:
            rate = float(10 ** rng.uniform(-2, 1))
            changing = Series(times=(-1.0, length / 2), values=(rate, rate / 2))
            varying = changing if rng.random() < 0.3 else rate
            arc = replace(arc, capacity_node=str(rng.choice(holders)), capacity_rate=varying)
        limits.append(arc)
    return limits


class _Values:
    """Draws numbers, of which some change in time."""

    def __init__(self, rng: np.random.Generator, length: float, changing: bool) -> None:
        self.rng, self._length, self._changing = rng, length, changing

    def __call__(self, value: float, most: float = 2.0) -> float | Series:
        """Return a value, or a series from it to at most ``most`` times as much."""
        if not self._changing or self.rng.random() < 0.6:
            return value
        inside = np.sort(self.rng.uniform(0, self._length, self.rng.integers(0, 4)))
        times = [-float(self.rng.integers(2)), *(inside + 1e-3), self._length + 2.0]  # tests lengthen intervals to 0.5
        values = value * self.rng.uniform(1.0, most, len(times))
        kind = str(self.rng.choice(["step", "linear"]))
        return Series(times=tuple(times), values=tuple(values.tolist()), interpolation=kind)

    def control(self, kind: ControlKind) -> Control:
        """Draw an actuator."""
        rng = self.rng
        most = 1.5 if kind is ControlKind.RATE else 10 ** rng.uniform(-1, 3)
        low, neutral, high = np.sort(rng.random(3)) * most
        low *= rng.integers(2)
        neutral = rng.choice([low, neutral, high])
        return Control(kind=kind, low=float(low), neutral=float(neutral), high=self(float(high)))

    def share(self, most: float) -> Control:
        """Draw what sets a share; of 20 of them the lower bounds and neutral values sum to less than 1."""
        low, neutral = np.sort(self.rng.uniform(0.0, 0.045, 2))
        high = self.rng.uniform(neutral, max(most, neutral + 0.001))
        return Control(kind=ControlKind.SHARE, low=float(low), neutral=float(neutral), high=float(high))


def _node(values: _Values, i: int, sets_flow: bool, stores: bool, divides: bool) -> Node:
    rng = values.rng
    low = float(rng.integers(2) * rng.uniform(0, 300))
    acts = sets_flow or i == 0 or rng.random() < 0.3
    initial = (low, low + float(rng.integers(2) * rng.uniform(0, 300)))
    control = values.control(ControlKind.FLOW if sets_flow else ControlKind.RATE) if acts and stores else None
    return Node(
        id=f"node_{i}",
        role=ROLES[rng.integers(len(ROLES))] if stores else Role.TECHNOSPHERE,
        stores=stores,
        initial=initial if stores else None,
        rate=values(float(10 ** rng.uniform(-2, 0.7))) if stores and divides else 0.0,
        set_point=float(rng.uniform(0, 300)) if rng.random() < 0.5 else None,
        scale=float(rng.uniform(1, 300)),
        control=control,
    )


def _living(rng: np.random.Generator, node: Node, interval: float, horizon: int) -> Node:
    """Return a node with a lifetime in place of a rate, perhaps with a history, or a stretch that changes."""
    kind, mean = str(rng.choice([*SURVIVALS, FIXED_LIFETIME])), interval * float(10 ** rng.uniform(0, 1.5))
    control, stretch = node.control, float(rng.uniform(0.5, 2))
    if kind == FIXED_LIFETIME:
        mean, control, stretch = round(mean / interval) * interval, None, 1.0
    elif control is not None:
        low, neutral, high = np.sort(rng.uniform(0.5, 3.0, 3)).tolist()
        control = Control(kind=ControlKind.STRETCH, low=low, neutral=neutral, high=high)
    history = None
    if rng.random() < 0.5:
        begins = sorted({float(t) for t in rng.uniform(-3 * mean, -interval, 3)})
        history = Series(times=tuple(begins), values=tuple(rng.uniform(1, 50, len(begins)).tolist()))
    changing = Series(times=(0.0, interval), values=(stretch, 1.2 * stretch)) if rng.random() < 0.5 else stretch
    return replace(
        node,
        rate=0.0,
        control=control,
        lifetime=Lifetime(
            mean=mean,
            deviation=mean * float(rng.uniform(0.4, 1)) if kind not in (FIXED_LIFETIME, "exponential") else None,
            distribution=kind,
        ),
        stretch=changing if kind != FIXED_LIFETIME else 1.0,
        history=history,
        growth=float(rng.uniform(-0.1, 0.3) / mean) if rng.random() < 0.5 else None,
        initial=None if history is not None and rng.random() < 0.5 else node.initial,
    )


def _arc(
    values: _Values, k: int, i: int, j: int, law: Law, donor_sets_flow: bool, stored: bool, interval: float
) -> Arc:
    rng, control, share = values.rng, None, None
    if law is Law.BATCH:
        times, masses = rng.integers(0, 5, 3) * interval, rng.uniform(0, 200, 3)
        return Arc(
            id=f"arc_{k}",
            donor=f"node_{i}",
            recipient=f"node_{j}",
            law=law,
            batches=tuple(zip(times.tolist(), masses.tolist(), strict=True)),
            delay=float(rng.integers(1, 4)) * interval,
            scale=float(rng.uniform(1, 100)),
            pollutant=bool(rng.integers(2)),
        )
    if law is Law.CONTROLLED and not donor_sets_flow:
        control = values.control(ControlKind.FLOW)
    elif law is Law.SHARE and rng.random() < 0.5:
        control = values.share(0.9 if stored else 0.045)
    elif law is Law.SHARE:
        share = values(float(rng.uniform(0, 0.02)))
    elif law is not Law.CONTROLLED and rng.random() < 0.4:
        control = values.control(ControlKind.RATE)
    flow: float | Series = 0.0
    if law is Law.EXOGENOUS:
        flow = values(float(rng.integers(0, 2) * rng.uniform(0, 200)), 5.0)
    return Arc(
        id=f"arc_{k}",
        donor=f"node_{i}",
        recipient=f"node_{j}",
        law=law,
        rate=values(float(10 ** rng.uniform(-2, 0.7))) if law in (Law.DONOR, Law.RECIPIENT) else 0.0,
        share=share,
        flow=flow,
        set_point=float(rng.uniform(0, 100)) if rng.random() < 0.3 else None,
        scale=float(rng.uniform(1, 100)),
        pollutant=bool(rng.integers(2)),
        control=control,
    )


def _services(values: _Values, nodes: int, arcs: int, batched: set[str], passing: set[int]) -> list[Service]:
    """Draw services: no outflow of a node in ``batched``, as batches are none, and no stock of one in ``passing``."""
    rng, services = values.rng, []
    for s in range(rng.integers(0, 3)):
        quantity = str(rng.choice(["stock", "outflow", "flow"] if arcs else ["stock", "outflow"]))
        provider = f"arc_{rng.integers(arcs)}" if quantity == "flow" else f"node_{rng.integers(nodes)}"
        if quantity == "outflow" and provider in batched:
            quantity = "stock"
        if quantity == "stock" and int(provider.removeprefix("node_")) in passing:
            quantity = "outflow"
        low = float(rng.uniform(0.1, 200))
        high = low * float(rng.uniform(1, 3)) if rng.integers(2) else np.inf
        services.append(
            Service(
                id=f"service_{s}",
                provider=provider,
                quantity=quantity,
                low=values(low, 1.0 if np.isfinite(high) else 2.0),
                high=high,
                weight=float(rng.random()),
            )
        )
    return services


def _joined(
    rng: np.random.Generator, service: Service, nodes: int, arcs: int, batched: set[str], passing: set[int]
) -> Service:
    """Return a service that adds up what further compartments deliver, of those that can deliver it."""
    ids = [f"arc_{k}" for k in range(arcs)] if service.quantity == "flow" else [f"node_{i}" for i in range(nodes)]
    if service.quantity == "stock":
        ids = [each for each in ids if int(each.removeprefix("node_")) not in passing]
    elif service.quantity == "outflow":
        ids = [each for each in ids if each not in batched]
    others = [each for each in ids if each != service.provider and rng.random() < 0.3]
    return replace(service, also=tuple(others))


def _drawn_network(seed: int, nodes: int, arcs: int, solver: str, *, lifetimes: bool) -> Network:
    network = random_network(seed, nodes, arcs, runge_kutta=solver == "rk4", lifetimes=lifetimes)
    return with_substances(network, seed) if solver == "substances" else network


st.register_type_strategy(
    Network,
    st.builds(
        _drawn_network,
        st.integers(0, 2**32 - 1),
        st.integers(1, 12),
        st.integers(0, 20),
        st.sampled_from(["exact", "substances", "rk4"]),
        lifetimes=st.sampled_from([False, False, True]),
    ),
)


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a test in an empty folder."""
    monkeypatch.chdir(tmp_path)
