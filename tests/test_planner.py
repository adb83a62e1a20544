"""The planner where its solver has a hard time: other units of mass, residence times of a fraction of a step."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import highspy
import numpy as np
import pytest
from small_networks import cycle, small

from cirl_marl import (
    Account,
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    Network,
    Node,
    Objective,
    Role,
    Service,
    load_network,
)
from cirl_marl.controllers.basic import Neutral
from cirl_marl.controllers.rollout import Rollout, rollout
from cirl_marl.definitions.catalogue import folder
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.network import Floats
from cirl_marl.network.elements import Lifetime
from cirl_marl.optimum import NoCertificate, Plan, bound, improve, improve_plan, program, search, simulate_plan, solver
from cirl_marl.optimum.aims import NO_AIMS
from cirl_marl.optimum.linearised import Span, StepProgram, step_program
from cirl_marl.optimum.mpc import MPC
from cirl_marl.optimum.planned_episodes import starting_states
from cirl_marl.optimum.slopes import jacobians
from cirl_marl.optimum.window_climb import WindowActions, WindowEpisode
from cirl_marl.optimum.window_planner import WindowPlanner
from cirl_marl.optimum.window_simulator import WindowSimulator
from cirl_marl.optimum.windows import WindowPlan, WindowTask

KILOTONNES = {"kg": 1e6, "kt": 1.0, "Gt": 1e-6}


def valve(low: float, high: float) -> Control:
    """Return a valve that is neutral at 1."""
    return Control(kind=ControlKind.RATE, low=low, neutral=1.0, high=high)


def yearly(residence: float = 0.25, horizon: int = 12, shortest: float = 1.0) -> Network:
    """Return a cycle of metal with yearly decisions, whose plants hold it for a fraction of a year."""
    fast = 1.0 / residence
    nodes = [
        Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(5e6, 5e6), scale=1e6),
        *(Node(id=name, initial=(6e4 / fast, 6e4 / fast), scale=6e4 / fast) for name in ("smelter", "works", "waste")),
        Node(id="cans", initial=(2e4, 2e4), scale=2e4),
        Node(id="buildings", initial=(1e6, 1e6), scale=1e6),
        Node(id="landfill", role=Role.LANDFILL, initial=(1e5, 1e5), scale=1e5),
    ]
    sets = Control(kind=ControlKind.FLOW, low=1e4, neutral=6e4, high=1.2e5)
    arcs = [
        Arc(id="mining", donor="mine", recipient="smelter", law=Law.CONTROLLED, control=sets),
        Arc(id="casting", donor="smelter", recipient="works", rate=fast),
        Arc(id="canning", donor="works", recipient="cans", rate=0.25 * fast),
        Arc(id="building", donor="works", recipient="buildings", rate=0.75 * fast, control=valve(0.5, 1.2)),
        Arc(id="cans_waste", donor="cans", recipient="waste", rate=1.0 / shortest),
        Arc(id="demolition", donor="buildings", recipient="waste", rate=1.0 / 25.0),
        Arc(id="recycling", donor="waste", recipient="smelter", rate=0.6 * fast, control=valve(0.2, 1.5)),
        Arc(id="dumping", donor="waste", recipient="landfill", rate=0.4 * fast, control=valve(0.1, 1.0)),
    ]
    return Network(
        name="yearly",
        nodes=tuple(nodes),
        arcs=tuple(arcs),
        services=(
            Service(id="housing", provider="buildings", quantity="stock", low=1.05e6),
            Service(id="drinks", provider="cans", quantity="stock", low=1.8e4),
        ),
        episode=Episode(control_interval=1.0, horizon=horizon),
        objective=Objective(circularity_scale=1e5),
        mass_unit="kt",
        time_unit="year",
    )


@pytest.mark.parametrize("residence", [0.5, 0.1])
@pytest.mark.slow
def test_residence_times_of_a_fraction_of_a_step(residence: float) -> None:
    """The certificate closes, and a plan comes within a percent of the bound at the demanded service."""
    found = bound(yearly(residence), min_service=0.97)
    proof = found.verify()
    assert proof.bound - proof.objective <= 1e-5 * abs(proof.bound)
    episode = simulate_plan(improve_plan(found, rounds=6))
    assert episode.episode_service[0] >= 0.97 - 1e-4
    assert 0.0 <= float(found.gap(episode.episode_circularity)[0]) < 0.01


@pytest.mark.parametrize("lives", [False, True])
def test_the_program_of_a_step_is_the_episode_to_first_order(lives: bool) -> None:
    """λ̄, the levels and the reserve of a small step; and of a large one, once it was tried, what it delivers."""
    network = yearly(0.5, horizon=5)
    changes: dict[str, Any] = {"mine": {"initial": (4.5e5, 4.5e5)}}
    if lives:
        lifetime = Lifetime(mean=25.0, deviation=8.0, distribution="normal")
        changes |= {"buildings": {"lifetime": lifetime, "growth": 0.0}, "demolition": {"law": Law.SHARE, "rate": 0.0}}
    nodes = tuple(replace(node, **changes.get(node.id, {})) for node in network.nodes)
    network = replace(network, nodes=nodes, arcs=tuple(replace(arc, **changes.get(arc.id, {})) for arc in network.arcs))
    found = bound(network, min_service=0.97, degree=1)
    found = replace(found, actions=0.5 * found.actions)
    dynamics, run, demand = Dynamics(found.network), simulate_plan(found), np.full(2, 0.97)
    slopes = jacobians(found, dynamics)

    def after(program: StepProgram, step: Floats) -> tuple[Rollout, Floats, Floats]:
        values = program.origin.copy()
        action = program.columns.action
        values[action] = step
        trial = simulate_plan(replace(found, actions=found.actions + step))
        moved = -(program.problem.under @ np.where(np.isin(np.arange(len(values)), action), values, 0.0))
        return trial, values, moved[: len(program.place)]

    rng = np.random.default_rng(1)
    for size, accuracy in ((1e-4, 1e-3), (0.3, None)):
        program = step_program(found, dynamics, run, demand, np.ones(2), 5.0, slopes)
        step = size * rng.uniform(-1, 1, found.actions.shape)
        trial, values, promised = after(program, step)
        place, row = program.place.T
        read = [np.concatenate([each.stock, each.flow], axis=1) @ program.measures.table.T for each in (run, trial)]
        change = (read[1] - read[0])[place, row]
        assert set(row.tolist()) == {0, 1, 2} and len(place) > 10
        if accuracy is not None:
            np.testing.assert_allclose(promised, change, rtol=0, atol=accuracy * np.abs(change).max())
            gain = float(trial.episode_circularity[0] - run.episode_circularity[0])
            cost = program.problem.cost[program.columns.action]
            assert -(cost * step).sum() == pytest.approx(gain, rel=2e-3)
        moved = program.with_correction(values, run, trial).problem.under_to - program.problem.under_to
        np.testing.assert_allclose(promised + moved[: len(place)], change, atol=1e-9 * np.abs(read[0]).max())
        assert not moved[len(place) :].any()


def test_a_step_that_promises_nothing_is_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    """Around the best plan, a valve that stays shut, one program is enough: a smaller region promises no more."""
    solved, best_values = list[Floats | None](), solver.best_values

    def counted(*arguments: Any) -> Floats | None:
        solved.append(best_values(*arguments))
        return solved[-1]

    valve = Control(kind=ControlKind.RATE, low=0.5, neutral=2.0, high=2.0)
    nodes = (
        Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(100.0, 100.0)),
        Node(id="use", initial=(1.0, 1.0)),
    )
    arc = Arc(id="mined", donor="mine", recipient="use", rate=0.4, control=valve)
    network = Network(name="valve", nodes=nodes, arcs=(arc,), episode=Episode(control_interval=0.5, horizon=4))
    monkeypatch.setattr(improve, "best_values", counted)
    plan = improve_plan(bound(network))
    assert len(solved) == 1
    np.testing.assert_allclose(plan.actions, -1.0, atol=1e-6)


def test_a_step_is_corrected_until_services_are_kept() -> None:
    """What a step to first order lacks of a service is made up for by what its own episode says, in the same round."""
    found = bound("copper_net", min_service=0.99, horizon=40, degree=1)
    for rounds in (1, 2):
        run = simulate_plan(improve_plan(found, rounds=rounds))
        assert run.episode_levels.min() >= 0.99 - 1e-4


@pytest.mark.parametrize(("stock", "sales", "demand"), [(10.0, 12.0, 0.5), (25.0, 12.0, 0.5), (25.0, 12.0, 0.9)])
def test_plans_keep_services_whose_price_the_bound_underrates(stock: float, sales: float, demand: float) -> None:
    """It lets a shop sell less and so hold more, where the simulator has it sell as long as there is anything."""
    supply = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=30.0)
    network = small(
        {"mine": 200.0, "shop": stock, "tip": 0.0},
        [
            Arc(id="supply", donor="mine", recipient="shop", law=Law.CONTROLLED, control=supply),
            Arc(id="sales", donor="shop", recipient="tip", law=Law.EXOGENOUS, flow=sales),
        ],
    )
    mine, *others = network.nodes
    service = Service(id="held", provider="shop", quantity="stock", low=15.0)
    nodes = (replace(mine, role=Role.NONRENEWABLE_RESERVOIR), *others)
    found = bound(replace(network, nodes=nodes, services=(service,)), min_service=demand)
    assert simulate_plan(improve_plan(found)).episode_levels.min() >= demand - 1e-4


def test_wide_slopes_see_orders_of_more_than_is_sold_at_once() -> None:
    """An empty shop holds little of a little more, as it sells what comes; of all of a range much is left."""
    supply = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=60.0)
    network = small(
        {"mine": 500.0, "van": 0.0, "shop": 0.0, "tip": 0.0},
        [
            Arc(id="order", donor="mine", recipient="van", law=Law.CONTROLLED, control=supply),
            Arc(id="delivery", donor="van", recipient="shop", rate=12.0),
            Arc(id="sales", donor="shop", recipient="tip", law=Law.EXOGENOUS, flow=24.0),
        ],
        horizon=3,
    )
    plan = replace(bound(network), actions=np.full((3, 1), -0.9))
    shop, dynamics = network.node_index["shop"], Dynamics(network)
    near, wide = (jacobians(plan, dynamics, is_wide=is_wide).by_action for is_wide in (False, True))
    before, full = simulate_plan(plan), simulate_plan(replace(plan, actions=np.ones((3, 1))))
    change = np.concatenate([full.stock[0], full.flow[0]]) - np.concatenate([before.stock[0], before.flow[0]])
    np.testing.assert_allclose(wide[0, :, 0], change / 1.9, rtol=1e-9, atol=1e-9)
    assert wide[0, shop, 0] > 3.0 * near[0, shop, 0] > 0.0


def test_a_step_over_whole_ranges_is_tried_before_prices_rise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a shop that is asked to hold more than its orders allow, where small steps serve no more."""
    supply = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=2.0)
    network = small(
        {"mine": 100.0, "shop": 30.0, "tip": 0.0},
        [
            Arc(id="order", donor="mine", recipient="shop", law=Law.CONTROLLED, control=supply),
            Arc(id="sales", donor="shop", recipient="tip", law=Law.EXOGENOUS, flow=12.0),
        ],
    )
    mine, *others = network.nodes
    service = Service(id="held", provider="shop", quantity="stock", low=15.0)
    nodes = (replace(mine, role=Role.NONRENEWABLE_RESERVOIR), *others)
    found, wide = bound(replace(network, nodes=nodes, services=(service,)), min_service=0.4), list[bool]()
    found = replace(found, min_service=np.array([0.9]))

    def counted(*arguments: Any, is_wide: bool) -> Any:
        wide.append(is_wide)
        return jacobians(*arguments, is_wide=is_wide)

    monkeypatch.setattr(improve, "jacobians", counted)
    assert simulate_plan(improve_plan(found)).episode_levels.max() < 0.5
    assert not wide[0] and any(wide) and not wide[wide.index(True) + 1]


def test_the_best_of_a_round_counts_and_what_it_lacks_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Corrections start from the first program, end with one that is worse or keeps services; demands end at 1."""
    found = bound("copper_net", min_service=0.995, horizon=3, degree=1)
    # worth and service of the plan, of three steps of the first round and of two of the second
    tried = iter([(0.0, 0.9), (1.0, 0.98), (3.0, 0.985), (2.0, 0.99), (2.5, 0.995), (4.0, 0.995)])
    demands, programs, corrected = list[float](), list[object](), list[object]()

    def episode(plan: object) -> SimpleNamespace:
        worth, level = next(tried)
        levels = np.full((1, len(found.network.services)), level)
        nothing = np.empty((1, 0))
        return SimpleNamespace(worth=worth, episode_levels=levels, accounts=nothing, bookings=nothing[..., None])

    class Step(SimpleNamespace):
        problem, scale = None, None
        columns = SimpleNamespace(action=np.arange(found.actions.size).reshape(found.actions.shape))
        idle = np.zeros(found.actions.shape, dtype=bool)

        def promise(self, values: Floats) -> float:
            return 1.0

        def with_correction(self, *about: object) -> SimpleNamespace:
            corrected.append(self)
            return Step()

    def program(
        plan: object, dynamics: object, run: object, demand: Floats, *rest: object, **budgets: object
    ) -> SimpleNamespace:
        demands.append(float(demand.max()))
        programs.append(Step())
        return cast(SimpleNamespace, programs[-1])

    steps = (np.full(found.actions.size, step) for step in 0.001 * 2.0 ** np.arange(5))
    monkeypatch.setattr(improve, "simulate_plan", episode)
    slopes = SimpleNamespace(supplies=SimpleNamespace(services=()))
    monkeypatch.setattr(improve, "jacobians", lambda *plan, is_wide: slopes)
    monkeypatch.setattr(improve, "step_program", program)
    monkeypatch.setattr(improve, "best_values", lambda problem, scale: next(steps))
    monkeypatch.setattr(improve.Trials, "value", lambda trials, run, price: run.worth)
    better = improve_plan(found, rounds=2, starts=1)
    np.testing.assert_allclose(better.actions, np.clip(np.clip(found.actions + 0.002, -1, 1) + 0.016, -1, 1))
    assert demands == [pytest.approx(0.995), 1.0]
    first, second = programs
    assert [each is first for each in corrected] == [True, True, False]
    assert corrected[2] is second and next(tried, None) is None


@pytest.mark.slow
def test_the_unit_of_mass_does_not_matter(tmp_path: Path) -> None:
    """In kg, kt and Gt: the same bound, plan, and episodes of the plan and of MPC."""
    text = (folder("envs") / "copper_net.toml").read_text(encoding="utf-8")
    assert 'mass = "kt"' in text
    shown = []
    for unit, factor in KILOTONNES.items():
        path = tmp_path / f"{unit}.toml"
        path.write_text(text.replace('mass = "kt"', f'mass = "{unit}"'), encoding="utf-8")
        network = load_network(path)
        found = bound(network, min_service=0.98, horizon=10, degree=1)
        planned = simulate_plan(improve_plan(found))
        env = MultiAgentVectorEnv(network, num_envs=1, horizon=6)
        controlled = rollout(env, MPC(min_service=0.98), seed=3)
        masses = [found.objective, planned.episode_circularity[0], controlled.episode_circularity[0]]
        services = [found.service, planned.episode_service[0], controlled.episode_service[0]]
        shown.append([*(float(mass) / factor for mass in masses), *map(float, services)])
    assert shown[0] == pytest.approx(shown[1], rel=1e-6)
    assert shown[2] == pytest.approx(shown[1], rel=1e-6)


@pytest.mark.parametrize("failing", [0, 1, 2])
def test_other_settings_are_tried(failing: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of the settings finds the bound alone; what HiGHS says of its answer does not count, what it proves does."""
    network = yearly(0.5, horizon=3)
    usual = bound(network).objective
    others = [settings for i, settings in enumerate(solver.SETTINGS) if i != failing]
    hurried = {**solver.SETTINGS[failing], "time_limit": 0.0}
    monkeypatch.setattr(solver, "SETTINGS", (hurried, *others))
    assert bound(network).objective == pytest.approx(usual, rel=1e-5)
    monkeypatch.setattr(highspy.Highs, "getModelStatus", lambda self: highspy.HighsModelStatus.kNotset)
    monkeypatch.setattr(solver, "SETTINGS", others)
    assert bound(network).objective == pytest.approx(usual, rel=1e-5)
    monkeypatch.setattr(solver, "SETTINGS", (hurried,))
    with pytest.raises(NoCertificate, match="network 'yearly': HiGHS did not solve the program of the bound: Not Set"):
        bound(network)


def test_the_first_settings_may_lie(monkeypatch: pytest.MonkeyPatch) -> None:
    """That nothing satisfies a program is for the settings without presolve to say."""
    network = yearly(0.5, horizon=3)
    usual, run = bound(network).objective, solver._ScaledProgram.run

    def lying(self: solver._ScaledProgram, settings: Any, basis: Any, **options: Any) -> highspy.Highs:
        highs = run(self, settings, basis, **options)
        if (settings or {}).get("presolve") != "off":
            highs.clearSolver()
            monkeypatch.setattr(highspy.Highs, "getModelStatus", lambda _: highspy.HighsModelStatus.kInfeasible)
        else:
            monkeypatch.setattr(highspy.Highs, "getModelStatus", lambda _: highspy.HighsModelStatus.kOptimal)
        return highs

    monkeypatch.setattr(solver._ScaledProgram, "run", lying)
    assert bound(network).objective == pytest.approx(usual, rel=1e-5)


def test_mpc_goes_on_where_a_plan_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """By its older plan, then neutrally; it says so, and plans anew once it can."""
    network = load_network("copper_net")
    env = MultiAgentVectorEnv(network, num_envs=1, horizon=12)
    usual = rollout(env, MPC(min_service=0.9), seed=1)
    controller, asked = MPC(min_service=0.9), 0
    solve = MPC._solve_window

    def hindered(self: MPC, *arguments: object) -> object:
        nonlocal asked
        asked += 1
        if asked == 2:
            raise solver.SolverFailure("here")
        return solve(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(MPC, "_solve_window", hindered)
    found = rollout(env, controller, seed=1)
    assert "here" in controller.note
    neutral = rollout(env, Neutral(), seed=1).episode_circularity[0]
    worse = usual.episode_circularity[0] - found.episode_circularity[0]
    assert -1e-3 <= worse / (usual.episode_circularity[0] - neutral) < 0.05
    asked = 1
    rollout(env, controller, seed=1)
    assert controller.note
    monkeypatch.setattr(MPC, "_solve_window", solve)
    rollout(env, controller, seed=1)
    assert not controller.note


def test_what_was_learnt_may_leave_no_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    """A window then begins anew, and what is carried out is the best plan that there was before a round without one."""
    env, controller = MultiAgentVectorEnv("copper_net", num_envs=1, horizon=12), MPC(min_service=0.9)
    plan, trial, best, failed = WindowPlanner.plan, WindowPlanner._trial, list[WindowPlan](), 0

    def observed(self: WindowPlanner, *arguments: Any) -> WindowPlan:
        best.append(plan(self, *arguments))
        return best[-1]

    def hindered(self: WindowPlanner, task: WindowTask, *arguments: Any, **options: Any) -> WindowPlan:
        nonlocal failed
        if task.corrections is not None:
            failed += 1
            raise (solver.Infeasible if failed % 2 else solver.SolverFailure)("here")
        return trial(self, task, *arguments, **options)

    monkeypatch.setattr(WindowPlanner, "plan", observed)
    monkeypatch.setattr(WindowPlanner, "_trial", hindered)
    run = rollout(env, controller, seed=1)
    assert not controller.note and len(best) == 3 and failed == 5  # in the first window nothing was learnt before
    actions = np.concatenate([plan.actions[:4] for plan in best])
    replayed = rollout(env, Plan(replace(bound(env.network, run.start, min_service=0.9), actions=actions)), seed=1)
    np.testing.assert_allclose(replayed.flow, run.flow, rtol=1e-9)


def test_neutral_actions_are_taken_where_a_plan_does_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program relaxes what constant controls can do, so that its plan may be worse than to do nothing."""
    env, plan = MultiAgentVectorEnv("copper_net", num_envs=1, horizon=8), WindowPlanner.plan

    def worse(self: WindowPlanner, *arguments: Any) -> WindowPlan:
        found = plan(self, *arguments)
        return replace(found, actions=np.ones_like(found.actions), value=-1e9)

    monkeypatch.setattr(WindowPlanner, "plan", worse)
    run, neutral = (rollout(env, controller, seed=1) for controller in (MPC(min_service=0.9), Neutral()))
    np.testing.assert_array_equal(run.flow, neutral.flow)


def test_valves_open_for_orders() -> None:
    """A donor whose outflows are orders alone opens its valve as far as the largest of them needs."""
    orders = [
        Arc(id=name, donor="a", recipient=name[-1], law=Law.EXOGENOUS, flow=flow, control=valve(0.0, 1.0))
        for name, flow in (("to_b", 10.0), ("to_c", 5.0))
    ]
    network = Network(
        name="orders",
        nodes=(
            Node(id="a", initial=(1000.0, 1000.0), control=replace(valve(0.0, 1.5), neutral=0.25)),
            Node(id="b", initial=(0.0, 0.0)),
            Node(id="c", initial=(0.0, 0.0)),
        ),
        arcs=(replace(orders[0], accounts={"cost": -1.0}), replace(orders[1], accounts={"cost": 2.0})),
        accounts=(Account(id="cost", unit="EUR_2023"),),
        episode=Episode(horizon=4),
    )
    found = bound(network, aim="cost")
    assert found.objective == pytest.approx(60.0)  # 1.5 times what earns, four times, and nothing that costs
    controlled = rollout(MultiAgentVectorEnv(network, num_envs=1), MPC(aim="cost"))
    for run in (simulate_plan(found), controlled):
        assert -run.accounts[0, 0] == pytest.approx(60.0)


def test_without_windows_the_plan_of_the_episode_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no window is solved, MPC goes on as the plan of the episode says, which it has for its prices."""
    env = MultiAgentVectorEnv("copper_net", num_envs=1, horizon=12)
    solve = MPC._plan

    def hindered(self: MPC, *arguments: Any, is_outlook: bool = False) -> WindowPlan:
        if not is_outlook:
            raise solver.SolverFailure("here")
        return solve(self, *arguments, is_outlook=is_outlook)

    monkeypatch.setattr(MPC, "_plan", hindered)
    controller = MPC(min_service=0.9, horizon=5)
    run = rollout(env, controller, seed=1)
    outlook = controller._outlooks[0]
    assert "here" in controller.note and outlook.task.intervals == range(12)
    followed = replace(bound(env.network, run.start, min_service=0.9), actions=outlook.actions)
    expected = rollout(env, Plan(followed), seed=1)
    np.testing.assert_allclose(run.flow, expected.flow, rtol=1e-9)


def test_scales_leave_the_programs_answer() -> None:
    """Multipliers come back in the units of the network: they prove what the plan does."""
    found = bound(replace(yearly(0.5, horizon=2), mass_unit="Mt"), service_weight=0.5)
    assert found.verify().bound == pytest.approx(found.verify().objective, rel=1e-6)


def test_a_plan_lies_within_its_boxes_too() -> None:
    """Any imbalance satisfies every row if it is large enough; where nothing touches the environment its box is 0."""
    found = bound(yearly(0.5, horizon=2))
    problem, layout = found.problem, found.problem.layout
    size = np.maximum(np.abs(problem.low), np.abs(problem.high))
    size[size == 0] = 1.0
    scaled = solver._ScaledProgram(problem, size)

    def feasible(plan: Floats) -> bool:
        answer = SimpleNamespace(getSolution=lambda: SimpleNamespace(col_value=plan / size))
        return scaled.is_feasible(cast(highspy.Highs, answer))

    plan = found.solution.copy()
    assert feasible(plan)
    plan[layout.imbalance] = 1.0
    assert not feasible(plan)


@pytest.mark.slow
def test_controllers_that_plan_set_shares() -> None:
    """MPC, the improved plan and the plan found by search beat neutral control where shares are set; none the bound."""
    network = cycle(hoarded=500.0)
    found = bound(network, service_weight=1.0)
    env = MultiAgentVectorEnv(network, num_envs=2)
    starts = starting_states(env) if env.reset(seed=0) else np.empty(0)
    assert starts[0] == pytest.approx(found.initial)

    def objective(run: Rollout) -> float:
        return float((run.episode_circularity / network.objective.circularity_scale + run.episode_service)[0])

    neutral, planned = objective(rollout(env, Neutral())), objective(simulate_plan(improve_plan(found, rounds=6)))
    controlled = objective(rollout(env, MPC(service_weight=1.0, replan=1)))
    searched = search(network, service_weight=1.0, population=16, iterations=4, knots=2)
    by_search = objective(rollout(env, Plan(searched)))
    assert neutral < min(planned, controlled, by_search)
    assert max(planned, controlled, by_search) <= found.objective + 1e-9
    assert planned >= found.objective - 0.02 * abs(found.objective)


def test_multipliers_of_merged_pieces_bound_other_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a schedule may be cut from one start and not from the other."""
    monkeypatch.setattr(program, "LARGE", 0)
    network = cycle(hoarded=500.0)
    found = bound(network)
    assert found.problem.layout.has_end_flows
    poor = found.initial.copy()
    poor[network.node_index["hoard"]] = 1.0
    proved, solved = float(found.at(poor)), bound(network, poor)
    assert proved >= solved.objective - 1e-6 * abs(solved.objective)
    assert solved.at(found.initial) >= found.objective - 1e-6 * abs(found.objective)
    run = simulate_plan(solved)
    assert run.episode_circularity[0] <= solved.objective


def test_the_program_of_a_step_reads_the_intervals_of_its_span() -> None:
    """A plan that begins later has the bands of its own years, and what may not change does not."""
    network, first, steps = load_network("steel_japan").with_options(episode={"horizon": 6}), 3, 3
    dynamics = Dynamics(network)
    initial = bound(network, min_service=0.5, degree=1).initial
    actions = np.zeros((steps, len(MultiAgentVectorEnv(network, num_envs=1).actuators.control_rows)))
    plan = WindowActions(network, (), initial, actions, None, NO_AIMS)
    stock, flow = WindowSimulator(dynamics, ()).run(initial, actions, first)
    services, arcs = len(network.services), len(network.arcs)
    run = WindowEpisode(0.0, np.ones((1, services, steps)), stock[1:], flow[:, :arcs], *np.empty((2, 1, 0)))
    demand, span = np.ones(services), Span(first, free=1)
    step = step_program(plan, dynamics, run, demand, demand, 2.0, jacobians(plan, dynamics, first), span=span)
    for row, (t, service) in enumerate(step.place.tolist()):
        if service < services:
            least = network.interval_means(network.services[service].low)[first + t]
            assert step.problem.under[[row]].toarray()[0, step.columns.level[t, service]] == pytest.approx(least)
    for ends in (step.problem.low, step.problem.high):
        assert (ends[step.columns.action[0]] != 0).any() and (ends[step.columns.action[1:]] == 0).all()
    assert len(step.place) > 3
