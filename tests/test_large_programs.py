"""Programs and plans of large networks: fewer pieces, other interior points, plans without Jacobians."""

from __future__ import annotations

import pickle
import signal
from types import SimpleNamespace
from typing import Any, cast

import highspy
import numpy as np
import pytest
from scipy import sparse
from small_networks import cycle

from benchmarks.yearly import LIFETIMES, yearly_network
from cirl_marl import (
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    Node,
    Role,
    Service,
    load_network,
)
from cirl_marl.controllers.rollout import rollout
from cirl_marl.optimum import (
    bound,
    improve,
    improve_plan,
    program,
    reach,
    simulate_plan,
    solver,
    transit,
    window_planner,
)
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.certificate import verify
from cirl_marl.optimum.improve import penalised_objective, prices
from cirl_marl.optimum.interruption import SLOW_PROGRAM, run_until_interrupt
from cirl_marl.optimum.mpc import MPC
from cirl_marl.optimum.options import starting_stocks
from cirl_marl.optimum.program import Programs


def turning_over(rate: float) -> Network:
    """Return a stock in use, fed from a mine, that turns over so often in an interval."""
    nodes = [
        Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(100.0, 100.0)),
        Node(id="use", initial=(1.0, 1.0)),
        Node(id="tip", role=Role.LANDFILL, initial=(0.0, 0.0)),
    ]
    arcs = [
        Arc(id="mining", donor="mine", recipient="use", rate=0.01),
        Arc(id="loss", donor="use", recipient="tip", rate=rate),
    ]
    episode = Episode(control_interval=1.0, horizon=4)
    return Network(name="turning_over", nodes=tuple(nodes), arcs=tuple(arcs), episode=episode)


@pytest.mark.parametrize(
    ("network", "merged"), [(load_network("steel_japan"), False), (turning_over(1.9), False), (turning_over(2.1), True)]
)
def test_pieces_are_merged_where_stocks_are_fast(
    network: Network, merged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A large program has one piece a year; rows about its end only if stocks turn over twice in it."""
    admissible = Admissible.of(network)
    fine = program._layout(admissible, 2, False, 2)
    monkeypatch.setattr(program, "LARGE", 0)
    layout = program._layout(admissible, 2, None, 2)
    assert (fine.pieces, layout.pieces, layout.coarse, layout.has_end_flows) == (2, 1, True, merged)


@pytest.mark.parametrize(("limit", "pieces"), [("LARGE", 2), ("LARGE_KERNELS", 2)])
def test_as_many_pieces_stay_as_a_program_may_have(limit: str, pieces: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Variables grow with the pieces, rows of lifetimes with their square; both become as many as is allowed."""
    admissible = Admissible.of(load_network("copper_world"))
    fine = program._layout(admissible, 99, False, 2)
    counted = {
        "LARGE": fine.size * admissible.network.episode.horizon,
        "LARGE_KERNELS": admissible.lifetimes.entries(fine),
    }
    share = (pieces + 0.5) / fine.pieces
    allowed = {"LARGE": counted["LARGE"] * share, "LARGE_KERNELS": counted["LARGE_KERNELS"] * share**2}
    monkeypatch.setattr(program, "MERGED", 1.0)
    monkeypatch.setattr(program, "LARGE", 10**9)
    monkeypatch.setattr(program, limit, allowed[limit])
    assert fine.pieces > pieces
    assert program._layout(admissible, 99, None, 2).pieces == pieces


@pytest.mark.medium
def test_coarse_pieces_bound_what_the_simulator_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bound is above its plan in the simulator, and near it."""
    monkeypatch.setattr(program, "LARGE", 0)
    found = bound("steel_japan", min_service=1.0, degree=1, horizon=6)
    assert found.problem.layout.coarse and not found.problem.layout.has_end_flows
    run = simulate_plan(found)
    assert run.episode_levels.min() > 0.999
    assert 0 < found.gap(run.episode_circularity[0]) < 0.02


def test_least_arrivals_are_below_those_of_the_inverse() -> None:
    """They are (I − P)⁻¹ R to rounding, never more, also where a loop keeps nearly all of what is in it."""
    random = np.random.default_rng(0)
    for kept in (0.5, 1 - 1e-6):
        shares = random.dirichlet(np.ones(6), size=6)
        passed, arriving = kept * shares, (1 - kept) * random.dirichlet(np.ones(2), size=6)
        visits = np.full(6, 1 / (1 - kept))
        found = reach._least_arrivals(sparse.csc_array(passed), arriving, visits)
        # all arrives somewhere, so that both stocks together get 1
        assert (found.sum(axis=1) <= 1.0).all()
        assert found.sum(axis=1) == pytest.approx(np.ones(6), abs=1e-7)
        assert found == pytest.approx(np.linalg.inv(np.eye(6) - passed) @ arriving, abs=1e-7)


def test_hipo_proves_the_bound_that_the_others_prove(monkeypatch: pytest.MonkeyPatch) -> None:
    """A large program is solved by HiPO, whose multipliers prove as much."""
    pytest.importorskip("highspy_extras")
    usual = bound("copper_net", min_service=0.9, degree=1, horizon=40)
    monkeypatch.setattr(solver, "LARGE_PROGRAM", 0)
    tried, run = list[solver.HighsOptions | None](), solver._ScaledProgram.run

    def noted(scaled: Any, options: solver.HighsOptions | None, basis: Any, **others: Any) -> Any:
        tried.append(options)
        return run(scaled, options, basis, **others)

    monkeypatch.setattr(solver._ScaledProgram, "run", noted)
    found = bound("copper_net", min_service=0.9, degree=1, horizon=40)
    assert tried == [solver.LARGE_SETTINGS[0]]
    assert found.basis is None
    assert found.verify().bound == pytest.approx(usual.objective, rel=solver.NEAR)


@pytest.mark.slow
def test_an_outlook_of_a_large_network_is_solved_once_and_roughly(monkeypatch: pytest.MonkeyPatch) -> None:
    """HiPO stops there at half a percent; windows serve and come as near the bound as after a good outlook."""
    pytest.importorskip("highspy_extras")
    tried, run = list[solver.HighsOptions | None](), solver._ScaledProgram.run

    def noted(scaled: Any, options: solver.HighsOptions | None, basis: Any, **others: Any) -> Any:
        tried.append(options)
        return run(scaled, options, basis, **others)

    monkeypatch.setattr(solver._ScaledProgram, "run", noted)
    reached = []
    for size in (solver.LARGE_PROGRAM, 1000):  # of 40 intervals there are more variables, of 10 fewer
        for module in (solver, window_planner):
            monkeypatch.setattr(module, "LARGE_PROGRAM", size)
        tried.clear()
        env = MultiAgentVectorEnv("copper_net", num_envs=1, horizon=40)
        reached.append(rollout(env, MPC(horizon=10, min_service=0.9), seed=0))
    assert tried[0] == solver.ROUGH_SETTINGS
    assert solver.ROUGH_SETTINGS not in tried[1:]
    good, rough = reached
    assert rough.least_service.min() > 0.9 - 2e-3
    assert rough.episode_circularity == pytest.approx(good.episode_circularity, rel=0.01)


@pytest.mark.parametrize(("most", "may_lack"), [(9.0, [False]), (1.0, [False, True])])
def test_a_large_outlook_lacks_service_only_where_it_must(
    most: float, may_lack: list[bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What can be had is no matter of prices; where it cannot, as much is planned as can be had."""
    pytest.importorskip("highspy_extras")
    tried, solve = list[bool](), solver.solve

    def noted(problem: program.Program, *others: Any, is_rough: bool = False, **options: Any) -> solver.Solution:
        if is_rough:
            tried.append(bool(problem.high[-1] > 0))
        return solve(problem, *others, is_rough=is_rough, **options)

    monkeypatch.setattr(window_planner, "solve", noted)
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=most, high=most)
    network = Network(
        name="in_use",
        nodes=(
            Node(id="reserve", role=Role.NONRENEWABLE_RESERVOIR, initial=(100.0, 100.0)),
            Node(id="use", initial=(10.0, 10.0)),
            Node(id="tip", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="extraction", donor="reserve", recipient="use", law=Law.CONTROLLED, control=order),
            Arc(id="loss", donor="use", recipient="tip", rate=0.3),
        ),
        services=(Service(id="served", provider="use", quantity="stock", low=10.0),),
        episode=Episode(control_interval=0.5, horizon=8),
    )
    for module in (solver, window_planner):
        monkeypatch.setattr(module, "LARGE_PROGRAM", 0)
    controller = MPC(horizon=3, min_service=0.95, degree=2, replan=1)
    run = rollout(MultiAgentVectorEnv(network, num_envs=1), controller, seed=0)
    assert tried == may_lack
    assert (run.least_service[0] > 0.95 - 2e-3) == (len(may_lack) == 1)


def test_middling_programs_of_windows_are_solved_by_interior_points_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither crossover nor a basis is waited for, and the plans serve as well."""
    tried, run = list[tuple[Any, bool]](), solver._ScaledProgram.run

    def noted(scaled: Any, options: solver.HighsOptions | None, basis: Any, **others: Any) -> Any:
        tried.append((options, basis is not None))
        return run(scaled, options, basis, **others)

    reached, tables = [], []
    for size in (solver.BASIS_PROGRAM, 0):
        monkeypatch.setattr(solver._ScaledProgram, "run", noted)
        monkeypatch.setattr(solver, "BASIS_PROGRAM", size)
        tried.clear()
        env = MultiAgentVectorEnv("copper_net", num_envs=1, horizon=8)
        reached.append(rollout(env, MPC(min_service=0.9), seed=0))
        tables.append(tried[:])
    assert any(has_basis for _, has_basis in tables[0])
    assert {(settings == solver.SETTINGS[1], has_basis) for settings, has_basis in tables[1]} == {(True, False)}
    usual, alone = reached
    assert alone.least_service.min() > 0.9 - 2e-3
    assert alone.episode_circularity == pytest.approx(usual.episode_circularity, rel=0.005)


@pytest.mark.parametrize("has_hipo", [True, False])
def test_a_middling_program_leaves_its_basis_and_takes_a_plan_whose_multipliers_went_wrong(
    has_hipo: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of what need not be certified; a smaller program goes on from its basis, and is tried again.

    Without the package of HiPO, IPX is the only one that is tried.
    """
    attempts = [*solver.MIDDLING_SETTINGS]
    if has_hipo:
        pytest.importorskip("highspy_extras")
    else:
        monkeypatch.setattr(solver, "find_spec", lambda name: None)
        attempts = [settings for settings in attempts if settings["solver"] != "hipo"]
        assert attempts == [solver.SETTINGS[1]]
    tried, run = list[tuple[Any, Any]](), solver._ScaledProgram.run
    problem = bound("copper_net", min_service=0.9, degree=1, horizon=8).problem
    basis = solver.solve(problem).basis
    assert basis is not None

    class Undecided:
        """HiGHS, which says that it does not know."""

        def __init__(self, highs: Any) -> None:
            self._highs = highs

        def __getattr__(self, name: str) -> Any:
            return getattr(self._highs, name)

        def getModelStatus(self) -> highspy.HighsModelStatus:
            return highspy.HighsModelStatus.kUnknown

    def noted(scaled: Any, options: solver.HighsOptions | None, start: Any, **others: Any) -> Any:
        tried.append((options, start))
        return Undecided(run(scaled, options, start, **others))

    monkeypatch.setattr(solver._ScaledProgram, "run", noted)
    monkeypatch.setattr(solver._ScaledProgram, "distance", lambda *_: 1.0)
    solver.solve(problem, basis, certify=False)
    assert tried[0] == (None, basis) and [options for options, _ in tried[1:]] == [*solver.SETTINGS]
    monkeypatch.setattr(solver, "BASIS_PROGRAM", 0)
    for size, first in ((solver.HIPO_PROGRAM, solver.SETTINGS[1]), (0, attempts[0])):
        monkeypatch.setattr(solver, "HIPO_PROGRAM", size)
        tried.clear()
        solver.solve(problem, basis, certify=False)
        assert tried == [(first, None)]
    # so does a large one, but where its multipliers are asked for
    monkeypatch.setattr(solver, "LARGE_PROGRAM", 0)
    for is_rough, every in ((False, solver.LARGE_SETTINGS), (True, (solver.ROUGH_SETTINGS, *solver.LARGE_SETTINGS))):
        tried.clear()
        solver.solve(problem, certify=False, is_rough=is_rough)
        possible = [options for options in every if has_hipo or options["solver"] != "hipo"]
        assert tried == [(options, None) for options in (possible if is_rough else possible[:1])]
    monkeypatch.setattr(solver, "LARGE_PROGRAM", 10**9)
    tried.clear()  # what interior points do not solve is given up
    monkeypatch.setattr(solver._ScaledProgram, "is_feasible", lambda *_: False)
    with pytest.raises(solver.SolverFailure):
        solver.solve(problem, basis, certify=False)
    assert tried == [(settings, None) for settings in attempts]


@pytest.mark.parametrize(
    ("values", "fits"), [([1.0, 0.5], True), ([0.0, 0.5], False), ([2.0, 0.5], False), ([1.0, 3.0], False)]
)
def test_values_fit_that_miss_no_row_and_no_box(values: list[float], fits: bool) -> None:
    """Whatever the solver says of them: with x = 1 and y ≤ 4 too little, too much and what is out of its box do not."""
    rows = sparse.csr_array(np.eye(2))
    problem = program.LinearProgram(
        cost=np.ones(2),
        equal=rows[[0]],
        equal_to=np.ones(1),
        under=rows[[1]],
        under_to=np.full(1, 4.0),
        low=np.zeros(2),
        high=np.full(2, 2.0),
    )
    answer: Any = SimpleNamespace(getSolution=lambda: SimpleNamespace(col_value=values))
    assert solver._ScaledProgram(problem, np.ones(2)).is_feasible(answer) == fits


@pytest.mark.parametrize(("distance", "count"), [(0.5 * solver.FAIR, 2), (2.0 * solver.FAIR, 4)])
def test_simplex_is_tried_where_interior_points_do_not_do(
    monkeypatch: pytest.MonkeyPatch, distance: float, count: int
) -> None:
    """Nobody knows how long simplex takes from nothing; that after interior points ends after a number of steps."""
    tried, run = list[Any](), solver._ScaledProgram.run
    problem = bound("copper_net", min_service=0.9, degree=1, horizon=8).problem

    def noted(scaled: Any, options: solver.HighsOptions | None, start: Any, **others: Any) -> Any:
        tried.append(options)
        highs = run(scaled, options, start, **others)
        if len(tried) == 1:
            limit = float(highs.getOptionValue("simplex_iteration_limit")[1])
            assert options is not None and options["solver"] == "ipx" and limit < solver.LARGE_PROGRAM
        return highs

    monkeypatch.setattr(solver._ScaledProgram, "run", noted)
    monkeypatch.setattr(solver._ScaledProgram, "distance", lambda *_: distance)
    solver.solve(problem)
    assert tried == [*solver.SETTINGS][:count]


@pytest.mark.parametrize(("limit", "merged"), [("PROOF_PROGRAM", False), ("MERGED_PROOF", True)])
def test_a_proof_of_many_variables_waits_for_no_crossover(
    limit: str, merged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Interior points alone are tried first, of fewer where pieces are merged, and are near enough at 1e-4."""
    problem = bound("copper_net", min_service=0.9, degree=1, horizon=4).problem
    monkeypatch.setattr(problem.layout, "has_end_flows", merged)
    tried, run = list[Any](), solver._ScaledProgram.run

    def noted(scaled: Any, options: Any, start: Any, **others: Any) -> Any:
        tried.append(options)
        return run(scaled, options, start, **others)

    monkeypatch.setattr(solver._ScaledProgram, "run", noted)
    monkeypatch.setattr(solver._ScaledProgram, "distance", lambda *_: (solver.OPTIMAL + solver.FAIR) / 2)
    monkeypatch.setattr(solver, limit, len(problem.cost))
    solver.solve(problem)
    assert tried == [solver.INTERIOR_SETTINGS[0]]


@pytest.mark.slow
def test_interior_points_alone_leave_good_multipliers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a generated cycle in merged pieces, where rows that presolve merges as parallel spoil them."""
    monkeypatch.setattr(program, "LARGE", 7000)
    admissible = Admissible.of(yearly_network(76, LIFETIMES).with_options(episode={"horizon": 6}))
    problem = Programs(admissible, 2, None).program(starting_stocks(admissible.lifetimes, None), 0.9)
    distances, distance = list[float](), solver._ScaledProgram.distance

    def noted(*answer: Any) -> float:
        distances.append(distance(*answer))
        return distances[-1]

    monkeypatch.setattr(solver._ScaledProgram, "distance", noted)
    monkeypatch.setattr(solver, "MERGED_PROOF", 0)
    assert solver.solve(problem).basis is None
    assert len(distances) == 1 and distances[0] <= solver.FAIR
    first = dict(solver.INTERIOR_SETTINGS[0])
    monkeypatch.setattr(solver, "INTERIOR_SETTINGS", ({**first, "presolve_rule_off": 0}, *solver.SETTINGS))
    solver.solve(problem)
    assert len(distances) > 2


@pytest.mark.slow
def test_few_choices_of_fast_stocks_tell_nearly_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of constant shares past fast stocks in merged pieces: another choice is not missed, each of these would be."""
    admissible = Admissible.of(yearly_network(110, LIFETIMES).with_options(episode={"horizon": 5}))
    start, choices = starting_stocks(admissible.lifetimes, None), transit.FAST
    proved = []
    for fast in (choices, (*choices, 0.5, 4.0), (np.inf,)):
        monkeypatch.setattr(transit, "FAST", fast)
        programs = Programs(admissible, 2, None, large=1000)
        assert programs.layout.pieces == 1 and programs.layout.has_end_flows
        problem = programs.program(start, 0.9)
        proved.append(verify(problem, (found := solver.solve(problem)).certificate, found.plan).bound)
    chosen, more, fewer = proved
    assert chosen == pytest.approx(more, rel=1e-4)
    assert fewer - chosen > 3e-4 * abs(chosen)


def test_without_hipo_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """The other interior points are tried for an hour; an error then names the extra."""
    hurried = ({**solver.LARGE_SETTINGS[0]}, {**solver.LARGE_SETTINGS[1], "time_limit": 0.0})
    monkeypatch.setattr(solver, "LARGE_PROGRAM", 0)
    monkeypatch.setattr(solver, "LARGE_SETTINGS", hurried)
    monkeypatch.setattr(solver, "find_spec", lambda name: None)
    with pytest.raises(solver.SolverFailure, match=r"'copper_net'.*pip install 'cirl-marl\[large\]'"):
        bound("copper_net", min_service=0.9, degree=1, horizon=40)


@pytest.mark.medium
def test_plans_of_large_networks_make_up_for_what_lacked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without any Jacobian the plan serves more than that of the bound, and is worth more by the same merit."""
    found = bound("copper_net", min_service=1.0, degree=1, horizon=40)
    monkeypatch.setattr(improve, "MOST_SLOPES", 0)
    monkeypatch.setattr(improve, "jacobians", None)
    better = improve_plan(found)
    before, after = simulate_plan(found), simulate_plan(better)
    assert better.objective == found.objective
    lacking = [1.0 - float(run.episode_levels.min()) for run in (before, after)]
    assert lacking[0] > 5e-4 and lacking[1] < 1e-4
    charged = prices(found)
    assert penalised_objective(found, after, charged) > penalised_objective(found, before, charged)


@pytest.mark.slow
def test_what_stocks_can_be_is_compiled_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bound, its better plans and what it proves elsewhere share the routes; what is sent elsewhere leaves them."""
    compiled: list[int] = []
    compile_routes = reach.RouteBounds.__init__

    def counted(routes: reach.RouteBounds, ranges: Any, visit_bounds: Any, step: int, wider: Any = None) -> None:
        compiled.append(step)
        compile_routes(routes, ranges, visit_bounds, step, wider)

    monkeypatch.setattr(reach.RouteBounds, "__init__", counted)
    monkeypatch.setattr(improve, "MOST_SLOPES", 0)
    found = bound(cycle(), min_service=0.7, degree=1)
    once = list(compiled)
    assert once and len(once) == len(set(once))
    better = improve_plan(found)
    assert found.at() == found.objective and compiled == once
    copied = pickle.loads(pickle.dumps(found))
    assert copied.at() == found.objective and compiled == 2 * once
    np.testing.assert_array_equal(improve_plan(copied).actions, better.actions)


@pytest.mark.parametrize("method", ["simplex", "ipx"])
def test_a_solver_that_runs_hears_of_ctrl_c(method: str) -> None:
    """And stops; what Ctrl-C does else, it does then, and afterwards as before."""
    rng, size = np.random.default_rng(0), 40
    heard: list[int] = []

    def press(_: Any) -> None:
        if not heard:
            heard.append(1)
            signal.raise_signal(signal.SIGINT)

    class Interrupted(highspy.Highs):
        """Is interrupted in its first iteration."""

        def run(self) -> Any:
            for callback in (self.cbSimplexInterrupt, self.cbIpmInterrupt):
                callback += press
            return super().run()

    highs: Any = cast(Any, Interrupted)()
    highs.setOptionValue("output_flag", False)
    highs.setOptionValue("solver", method)
    highs.setOptionValue("presolve", "off")
    columns = [highs.addVariable(lb=0, ub=10, obj=float(cost)) for cost in -rng.random(size)]
    for row in rng.random((size, size)):
        highs.addConstr(sum(float(part) * column for part, column in zip(row, columns, strict=True)) <= 9.0)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run_until_interrupt(highs, SLOW_PROGRAM)
    assert highs.getModelStatus() == highspy.HighsModelStatus.kInterrupt
    assert heard and signal.getsignal(signal.SIGINT) is before
