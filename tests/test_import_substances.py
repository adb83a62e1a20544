"""Substances in tables of flows: import, round trips and reconciliation."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from typer.testing import CliRunner

from cirl_marl import (
    Arc,
    CirlError,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    Node,
    Role,
    Series,
    Substance,
    load_network,
)
from cirl_marl.cli import app
from cirl_marl.importing import definition
from cirl_marl.importing.assembly import ImportReport, import_flows
from cirl_marl.importing.flow_table import read_stocks
from cirl_marl.importing.substance_flows import closest_amounts, degrees_of_freedom, excesses

LONG = ["process", "year", "substance", "value", "unit"]
HEADER = ["source", "target", "year", "substance", "value", "unit", "uncertainty"]
STOCKS = ["region", "process", "year", "value", "unit"]
ROLES = {"nonrenewable_reservoir": ["Mine*"], "landfill": ["[DP]*[pt]"]}
Row = Sequence[object]


def table(path: Path, rows: Sequence[Row], header: Sequence[str] = HEADER) -> Path:
    """Write a CSV file."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header, *rows])
    return path


def sorting(copper: Sequence[object] = (4, 1, 3), unit: str = "kt/year") -> list[list[object]]:
    """Return ore that is sorted, with the copper in ore, product and dump."""
    flows = (("Mine", "Sorter", 100), ("Sorter", "Product", 90), ("Sorter", "Dump", 10))
    rows: list[list[object]] = [[*ends, 2000, "", value, "kt/year", "10 %"] for *ends, value in flows]
    rows += [
        [*ends, 2000, "Copper", part, unit, "10 %"]
        for (*ends, _), part in zip(flows, copper, strict=True)
        if part != ""
    ]
    return rows


def imported(tmp_path: Path, rows: Sequence[Row], **options: object) -> ImportReport:
    """Import a table."""
    return import_flows(table(tmp_path / "flows.csv", rows), tmp_path / "net.toml", roles=ROLES, **options)  # type: ignore[arg-type]


def amounts_of(report: ImportReport) -> np.ndarray:
    """Return what there is of substances in the flows, (substances, regions, years, pairs)."""
    assert report.table.substances is not None
    return report.table.substances.amounts


def simulated(network: Network) -> tuple[np.ndarray, np.ndarray]:
    """Return flows, (steps, arcs), and substances in them, (steps, substances, arcs), without agents."""
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    flows, substances = [], []
    for _ in range(network.episode.horizon):
        env.advance(np.zeros((len(env.actuators.control_rows), 1)))
        flows.append(env.physical.flow[:, 0])
        substances.append(env.physical.substances.reshape(len(network.substances), -1))
    return np.array(flows), np.array(substances)


@pytest.mark.parametrize(("amounts", "unit"), [((4, 1, 3), "kt/year"), ((4, 10 / 9, 30), "%"), ((4, 1, 3), "kt")])
def test_contents_and_amounts_become_shares_of_each(amounts: Sequence[float], unit: str, tmp_path: Path) -> None:
    """A process that separates has shares of copper of its own; a table may say parts or amounts."""
    report = imported(tmp_path, sorting(amounts, unit))
    network = load_network(tmp_path / "net.toml")
    assert [substance.id for substance in network.substances] == ["copper"]
    assert dict(network.nodes[0].content)["copper"] == pytest.approx(0.04)
    dumped = network.compartments["sorter_to_dump"]
    assert isinstance(dumped, Arc) and isinstance(dumped.share, Series)
    assert dumped.share.values[0] == pytest.approx(7 / 96)
    assert network.interval_means(dict(dumped.transfer)["copper"])[0] == pytest.approx(0.75)
    assert report.content_error < 1e-9


def test_what_a_process_does_not_separate_has_no_transfer(tmp_path: Path) -> None:
    """Where all that leaves is alike shares are enough, and a content that stays the same is a number."""
    imported(tmp_path, sorting((4, 3.6, 0.4)))
    text = (tmp_path / "net.toml").read_text()
    assert "transfer" not in text and "content.copper = { value = 0.04," in text


def test_sources_that_give_different_things_become_several(tmp_path: Path) -> None:
    """An arc with contents of its own has a source of its own, with the role of the one of the table."""
    rows = [*sorting((4, 1, 3)), ["Mine", "Product", 2000, "", 50, "kt/year", ""]]
    rows.append(["Mine", "Product", 2000, "Copper", 0.1, "%", ""])
    imported(tmp_path, rows)
    network = load_network(tmp_path / "net.toml")
    sources = [node for node in network.nodes if node.role is Role.NONRENEWABLE_RESERVOIR]
    assert {node.title: network.interval_means(dict(node.content)["copper"])[0].round(9) for node in sources} == {
        "Mine for Sorter": 0.04,
        "Mine for Product": 0.001,
    }


def test_processes_mix_what_the_table_does_not_tell(tmp_path: Path) -> None:
    """Of which no outflow says anything: shares are enough. A 0 is told, and does not balance."""
    report = imported(tmp_path, sorting((4, "", "")))
    np.testing.assert_allclose(amounts_of(report)[0, 0, 0], [4, 3.6, 0.4], rtol=1e-12)
    assert "transfer" not in (tmp_path / "net.toml").read_text()
    with pytest.raises(CirlError, match=r"'Sorter' \(2000, Copper\): 4 enter, 0 leave"):
        import_flows(table(tmp_path / "0.csv", sorting((4, 0, 0))), tmp_path / "zero.toml", roles=ROLES)


def test_mixing_goes_round_loops_and_is_little_trusted(tmp_path: Path) -> None:
    """What comes back is mixed again; an amount that follows from others gives way to one that was measured."""
    rows = [*sorting((4, "", "")), ["Works", "Sorter", 2000, "", 20, "kt/year", ""]]
    rows[1][:2], rows[1][4] = ["Sorter", "Works"], 110.0
    rows.append(["Works", "Product", 2000, "", 90, "kt/year", ""])
    report = imported(tmp_path, rows)
    amounts = dict(zip(map(str, report.table.pairs), amounts_of(report)[0, 0, 0], strict=True))
    assert amounts["'Works' to 'Product'"] == pytest.approx(3.6) and amounts["'Sorter' to 'Dump'"] == pytest.approx(0.4)
    assert amounts["'Works' to 'Sorter'"] == pytest.approx(0.04 * 20)
    rows.append(["Works", "Product", 2000, "Copper", 3.0, "kt/year", "1 %"])
    rows.append(["Works", "Sorter", 2000, "Copper", 1.0, "kt/year", "1 %"])
    again = import_flows(table(tmp_path / "2.csv", rows), tmp_path / "again.toml", roles=ROLES, reconcile=True)
    amounts = dict(zip(map(str, again.table.pairs), amounts_of(again)[0, 0, 0], strict=True))
    assert amounts["'Works' to 'Product'"] == pytest.approx(3.0, rel=0.01)
    assert amounts["'Sorter' to 'Dump'"] == pytest.approx(0.7, rel=0.05)  # of 0.6 too much half each, by 0.4 and 0.4


def test_stores_do_not_hand_on_what_the_table_does_not_tell(tmp_path: Path) -> None:
    """What leaves a store is not what enters it."""
    rows: list[Row] = [["Mine", "Use", 2000, s, v, "kt/year", ""] for s, v in (("", 10.0), ("Copper", 0.2))]
    rows.append(["Use", "Dump", 2000, "", 5.0, "kt/year", ""])
    report = imported(tmp_path, rows, stores=["Use"])
    assert amounts_of(report)[0, 0, 0].tolist() == [0.2, 0.0]


def cascade(seed: int, years: int = 4) -> Network:
    """Return a random network of two sources, three processes that separate and two sinks, with contents in time."""
    rng = np.random.default_rng(seed)

    def series(low: float, high: float) -> Series:
        return Series(times=tuple(map(float, range(years))), values=tuple(rng.uniform(low, high, years).tolist()))

    def content() -> dict[str, Series]:
        return {"copper": series(0.0, 0.4), "tin": series(0.0, 0.3)}

    def split(donor: str, recipients: Sequence[str]) -> list[Arc]:
        arcs = []
        for recipient in recipients[1:]:
            transfer = {"copper": series(0.05, 0.45)} if rng.random() < 0.7 else {}
            arcs.append(
                Arc(
                    id=f"{donor}_to_{recipient}",
                    donor=donor,
                    recipient=recipient,
                    law=Law.SHARE,
                    share=series(0.05, 0.45),
                    transfer=transfer,
                )
            )
        return [Arc(id=f"{donor}_to_{recipients[0]}", donor=donor, recipient=recipients[0], law=Law.SHARE), *arcs]

    return Network(
        name="cascade",
        nodes=(
            *(Node(id=f"mine_{i}", role=Role.NONRENEWABLE_RESERVOIR, content=content()) for i in range(2)),
            *(Node(id=f"process_{i}", stores=False) for i in range(3)),
            *(Node(id=id_, role=Role.LANDFILL, initial=(0.0, 0.0)) for id_ in ("dump", "product")),
        ),
        arcs=(
            *(
                Arc(
                    id=f"mine_{i}_to_process_{j}",
                    donor=f"mine_{i}",
                    recipient=f"process_{j}",
                    law=Law.EXOGENOUS,
                    flow=series(1.0, 9.0),
                )
                for i, j in ((0, 0), (0, 1), (1, 0))
            ),
            *split("process_0", ("process_1", "dump")),
            *split("process_1", ("product", "dump", "process_2")),
            *split("process_2", ("process_0", "product")),
        ),
        substances=(Substance(id="copper"), Substance(id="tin")),
        mass_unit="kt",
        time_unit="year",
        episode=Episode(control_interval=1.0, horizon=years),
    )


@given(seed=st.integers(0, 2**32 - 1))
def test_simulated_contents_come_back(seed: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    """A table of the flows and contents of a network is imported as one that has these flows and contents."""
    network = cascade(seed)
    flows, substances = simulated(network)
    rows: list[Row] = []
    for y, k in np.ndindex(flows.shape):
        arc = network.arcs[k]
        ends = [arc.donor.capitalize(), arc.recipient.capitalize(), 2000 + y]
        rows.append([*ends, "", float(flows[y, k]), "kt/year", ""])
        content = substances[y, :, k] / flows[y, k]
        rows.append([*ends, "copper", float(substances[y, 0, k]), "kt/year", ""])
        rows.append([*ends, "tin", float(100 * content[1]), "%", ""])
    report = imported(tmp_path_factory.mktemp("trip"), rows)
    again = load_network(report.files[0])
    flows_again, substances_again = simulated(again)
    order = [again.arc_index[arc.id] for arc in network.arcs]
    np.testing.assert_allclose(flows_again[:, order], flows, rtol=1e-9)
    np.testing.assert_allclose(substances_again[..., order], substances, rtol=1e-8, atol=1e-9)
    assert report.content_error < 1e-9


def test_stores_mix_what_the_table_says(tmp_path: Path) -> None:
    """A store starts with the content of what leaves it first, and the report says how far mixing is from the table."""
    rows: list[Row] = []
    for y, back in enumerate((0.02, 0.02, 0.03)):
        rows += [["Mine", "Use", 2000 + y, s, v, "kt/year", ""] for s, v in (("", 10.0), ("Copper", 0.2))]
        rows += [["Use", "Dump", 2000 + y, s, v, "kt/year", ""] for s, v in (("", 5.0), ("Copper", 5 * back))]
    report = imported(tmp_path, rows, stores=["Use"])
    use = load_network(tmp_path / "net.toml").compartments["use"]
    assert isinstance(use, Node) and dict(use.content)["copper"] == pytest.approx(0.02)
    assert report.content_error == pytest.approx(0.01, rel=1e-6)


def test_a_store_that_mixes_is_told_from_one_that_runs_empty(tmp_path: Path) -> None:
    """Who separates what a store gives sends other masses on if that has another content than in the table."""
    flows = (("Mine", "Use", 100, 10), ("Use", "Sorter", 30, 3), ("Use", "Dump", 30, ""))
    sorted_ = (("Sorter", "Product", 20, 0.5), ("Sorter", "Dump", 10, 2.5))
    rows = [
        [*ends, 2000, name, amount, "kt/year", ""]
        for *ends, whole, copper in (*flows, *sorted_)
        for name, amount in (("", whole), ("Copper", copper))
        if amount != ""
    ]
    message = r"give back 'Sorter' to '.*; of 'Use' to 'Sorter' 0\.05 is Copper, not 0\.1: a store mixes what it holds"
    with pytest.raises(CirlError, match=message):
        imported(tmp_path, rows, stores=["Use"])
    rows.append(["Use", "Dump", 2000, "Copper", 3, "kt/year", ""])
    assert imported(tmp_path, rows, stores=["Use"]).content_error < 1e-9


def test_regions_have_contents_of_their_own(tmp_path: Path) -> None:
    """Each is a network with its contents, of sources and of stores."""
    header = [*HEADER, "region"]
    rows: list[Row] = []
    for region, part in (("North", 0.02), ("South", 0.05)):
        for y in range(2):
            for source, target, value in (("Mine", "Use", 10.0), ("Use", "Dump", 4.0)):
                rows.append([source, target, 2000 + y, "", value, "kt/year", "", region])
                rows.append([source, target, 2000 + y, "Copper", value * part, "kt/year", "", region])
    path = table(tmp_path / "flows.csv", rows, header)
    import_flows(path, tmp_path / "net.toml", roles=ROLES, stores=["Use"])
    for region, part in (("north", 0.02), ("south", 0.05)):
        network = load_network(f"{tmp_path / 'net.toml'}:{region}")
        _, substances = simulated(network)
        np.testing.assert_allclose(substances[:, 0], np.array([[10.0, 4.0]] * 2) * part, rtol=1e-9)
    only = import_flows(path, tmp_path / "south.toml", roles=ROLES, stores=["Use"], regions=["South"])
    assert amounts_of(only)[0, 0, 0].tolist() == pytest.approx([0.5, 0.2])


def test_a_small_reconciliation_by_hand(tmp_path: Path) -> None:
    """Of 4.4 kt that enter and 1 + 3 that leave, with 10 % each: Lagrange's multiplier is 0.4/Σσ²."""
    report = imported(tmp_path, sorting((4.4, 1, 3)), reconcile=True)
    variances = np.array([0.44, 0.1, 0.3]) ** 2
    price = 0.4 / variances.sum()
    closest = np.array([4.4, 1, 3]) + np.array([-1, 1, 1]) * price * variances
    np.testing.assert_allclose(amounts_of(report)[0, 0, 0], closest, rtol=1e-9)
    assert report.reconciliation is not None and report.reconciliation.degrees == 2
    assert report.reconciliation.chi_square == pytest.approx(0.4**2 / variances.sum(), rel=1e-9)
    assert {change.substance for change in report.changes} == {"Copper"}
    with (tmp_path / "net_changes.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert {line["substance"] for line in lines} == {"Copper"} and len(lines) == 3


def test_contents_of_flows_that_are_adjusted_stay(tmp_path: Path) -> None:
    """Where a part was measured it is of the adjusted flow; amounts stay what they were."""
    rows = sorting((4, 10 / 9, 30), "%")
    rows[0][4] = 110
    report = imported(tmp_path, rows, reconcile=True)
    flows = report.table.grid(report.table.values)[0, 0]
    variances = (0.1 * np.array([110.0, 90.0, 10.0])) ** 2
    np.testing.assert_allclose(
        flows, np.array([110, 90, 10]) + 10 / variances.sum() * variances * np.array([-1, 1, 1]), rtol=1e-9
    )
    measured = flows * np.array([0.04, 1 / 90, 0.3])
    spread = (0.1 * measured) ** 2
    gap = measured[0] - measured[1:].sum()
    expected = measured + gap / spread.sum() * spread * np.array([-1, 1, 1])
    np.testing.assert_allclose(amounts_of(report)[0, 0, 0], expected, rtol=1e-9)


def test_amounts_stay_where_flows_are_adjusted(tmp_path: Path) -> None:
    """An amount that balances is as it was measured, whatever becomes of the flow that it is in."""
    rows = sorting((4, 1, 3))
    rows[0][4] = 110
    report = imported(tmp_path, rows, reconcile=True)
    np.testing.assert_allclose(amounts_of(report)[0, 0, 0], [4, 1, 3], rtol=1e-12)


def test_amounts_without_uncertainty_err_by_a_tenth(tmp_path: Path) -> None:
    """As flows do: χ² is that of 10 % deviations."""
    rows = [[*row[:6], ""] if row[3] else row for row in sorting((4.4, 1, 3))]
    report = imported(tmp_path, rows, reconcile=True)
    assert report.reconciliation is not None
    assert report.reconciliation.chi_square == pytest.approx(0.4**2 / (0.44**2 + 0.1**2 + 0.3**2), rel=1e-9)


def test_degrees_are_those_of_uncertain_amounts() -> None:
    """A balance of amounts that are known says nothing of the others; nor does one that follows from others."""
    balances = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 1.0, -1.0, 0.0], [1.0, 0.0, -1.0, 0.0]])
    assert degrees_of_freedom(np.array([[1.0, 1.0, 1.0, 0.0]]), balances) == 2
    assert degrees_of_freedom(np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0]]), balances) == 1


@pytest.mark.parametrize(
    ("amounts", "deviations"),
    [((4.0, 0.4, 3.6), (0.0, 1.0, 1.0)), ((4.0, 0.4, 3.6), (1e-9, 0.0, 0.0)), ((4.0, 0.0, 4.0), (0.0, 0.0, 0.0))],
)
def test_what_no_flow_can_hold_is_told(amounts: tuple[float, ...], deviations: tuple[float, ...]) -> None:
    """Of 4 t that enter for sure no more than 3 and 0.5 t can leave; nor are 3.6 t in a flow of 3."""
    balances, flow = np.array([[1.0, -1.0, -1.0]]), np.array([100.0, 0.5, 3.0])
    assert closest_amounts(np.array([amounts]), np.array([deviations]), flow, balances) is None


@pytest.mark.parametrize(("gap", "balances_enough"), [(1e-5, False), (1e-8, True)])
def test_certain_amounts_balance_to_a_ten_millionth(gap: float, balances_enough: bool) -> None:
    """Of what there is most of; nobody can change what is certain."""
    amounts, balances = np.array([[4.0 * (1 + gap), 1.0, 3.0]]), np.array([[1.0, -1.0, -1.0]])
    result = closest_amounts(amounts, np.zeros((1, 3)), np.full(3, 100.0), balances)
    assert (result is not None) is balances_enough


def test_substances_together_are_no_more_than_the_flow() -> None:
    """Of 10 t 6 t are of one, and 5 t of another."""
    amounts = np.array([[6.0, 6.0], [5.0, 4.0]]).reshape(2, 1, 1, 2)
    assert [*excesses(amounts, np.full((1, 1, 2), 10.0))] == [(0, 0, 0)]


def test_pure_substances_and_flows_of_nothing(tmp_path: Path) -> None:
    """What is a substance alone is shared out as it was; a year without a flow has the content of another one."""
    rows: list[Row] = []
    for y, (dumped, part) in enumerate(((1.0, 1.0), (0.0, 1.0))):
        for ends, flow in (
            (("Mine", "Sorter"), 10.0),
            (("Sorter", "Product"), 10.0 - dumped),
            (("Sorter", "Dump"), dumped),
        ):
            rows.append([*ends, 2000 + y, "", flow, "kt/year", ""])
            if flow:
                rows.append([*ends, 2000 + y, "Copper", 100 * part, "%", ""])
    assert imported(tmp_path, rows).content_error < 1e-9


def test_traces_that_do_not_balance_are_told(tmp_path: Path) -> None:
    """Rounding is a part of what there is of the substance, not of the flow."""
    with pytest.raises(CirlError, match=r"'Sorter' \(2000, Copper\): 4e-06 enter, 3e-06 leave"):
        imported(tmp_path, sorting((4e-6, 1e-6, 2e-6)))


def random_measurements(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return true amounts of two substances, measured ones, deviations, flows and balances of a random chain."""
    rng = np.random.default_rng(seed)
    flows, substances = simulated(cascade(seed, years=1))
    flow, true = flows[0], substances[0]
    balances = np.zeros((3, len(flow)))
    for k, arc in enumerate(cascade(seed, years=1).arcs):
        for end, sign in ((arc.donor, -1.0), (arc.recipient, 1.0)):
            if end.startswith("process"):
                balances[int(end[-1]), k] += sign
    deviations = true * rng.uniform(0.05, 0.5, true.shape) + 1e-3
    measured = np.maximum(true + deviations * rng.normal(size=true.shape), 0.0)
    return true, measured, deviations, flow, balances


@given(seed=st.integers(0, 2**32 - 1))
def test_amounts_are_the_closest_that_balance_within_flows(seed: int) -> None:
    """They balance, are no more than the flow, and no other solution that a general solver finds is closer."""
    true, measured, deviations, flow, balances = random_measurements(seed)
    flow = np.maximum(true.sum(axis=0) * (1 + 1e-6), flow * np.random.default_rng(seed).uniform(0.2, 1.0))
    flow[balances.any(axis=0)] = np.maximum(flow, true.sum(axis=0))[balances.any(axis=0)]
    closest = closest_amounts(measured, deviations, flow, balances)
    assert closest is not None
    np.testing.assert_allclose(balances @ closest.T, 0.0, atol=1e-8 * flow.max())
    assert closest.min() >= 0.0 and (closest.sum(axis=0) <= flow + 1e-8 * flow.max()).all()
    distance = (((closest - measured) / deviations) ** 2).sum()
    assert distance <= (((true - measured) / deviations) ** 2).sum() + 1e-6
    shape = measured.shape
    other = minimize(
        lambda x: (((x.reshape(shape) - measured) / deviations) ** 2).sum(),
        true.ravel(),
        jac=lambda x: (2 * (x.reshape(shape) - measured) / deviations**2).ravel(),
        bounds=[(0, None)] * measured.size,
        constraints=[
            {"type": "eq", "fun": lambda x: (balances @ x.reshape(shape).T).ravel()},
            {"type": "ineq", "fun": lambda x: flow - x.reshape(shape).sum(axis=0)},
        ],
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-12},
    )
    feasible = np.abs(balances @ other.x.reshape(shape).T).max() < 1e-7
    assert not feasible or distance <= other.fun * (1 + 1e-5) + 1e-5


@pytest.mark.slow
def test_reconciled_amounts_are_nearer_to_the_truth() -> None:
    """Of measurements that err as stated the sum of squares falls by the degrees of freedom of the balances."""
    gains, distances = [], []
    for seed in range(200):
        true, measured, deviations, flow, balances = random_measurements(seed)
        deviations = 0.02 * true + 1e-9
        measured = true + deviations * np.random.default_rng(seed + 1000).normal(size=true.shape)
        closest = closest_amounts(measured, deviations, flow, balances)
        assert closest is not None
        distances.append((((closest - measured) / deviations) ** 2).sum())
        gains.append((((measured - true) / deviations) ** 2).sum() - (((closest - true) / deviations) ** 2).sum())
    assert np.mean(distances) == pytest.approx(6.0, rel=0.15)  # three balances of two substances
    np.testing.assert_allclose(gains, distances, rtol=1e-6, atol=1e-6)  # by Pythagoras, as no limit binds


def test_more_than_the_flow_is_brought_within_it(tmp_path: Path) -> None:
    """The dump of 10 kt takes no more than that of copper, however much is measured."""
    report = imported(tmp_path, sorting((14, 2, 13)), reconcile=True)
    amounts = amounts_of(report)[0, 0, 0]
    assert amounts[2] == pytest.approx(10.0, rel=1e-9)
    assert amounts[0] == pytest.approx(amounts[1] + amounts[2], rel=1e-9)


@pytest.mark.parametrize(
    ("rows", "options", "message"),
    [
        (sorting((4, 1, 2)), {}, r"'Sorter' \(2000, Copper\): 4 enter, 3 leave"),
        (sorting((12, 1, 11)), {}, r"'Sorter' to 'Dump' \(2000\): 11 Copper in 10 kt/year: no more than all of it"),
        (
            [*sorting(), ["Mine", "Dump", 2000, "Copper", 1, "%", ""]],
            {},
            "line 8: Copper of 'Mine' to 'Dump' in 2000: there is no such flow",
        ),
        ([*sorting(), sorting()[3]], {}, "line 8: Copper of 'Mine' to 'Sorter' in 2000 stands in line 5 too"),
        (
            sorting((4, 130, 3), unit="%"),
            {"reconcile": True},
            "'Sorter' to 'Product' in 2000: 130 % is more than there is",
        ),
        (
            sorting(unit="GJ"),
            {},
            "line 5: unit 'GJ'.*of a substance give a part, as in % or ppm, or an amount in kt/year",
        ),
        (
            [*sorting((4, 1, 3))[:4], *([*row[:6], "0"] for row in sorting((4, 1, 2))[4:])],
            {"reconcile": True},
            None,
        ),
        (
            [*sorting()[:3], *([*row[:6], "0"] for row in sorting((4, 1, 2))[3:])],
            {"reconcile": True},
            "2000: no amounts of Copper balance within the flows; state how uncertain they are",
        ),
    ],
)
def test_bad_tables_are_refused(rows: list[Row], options: dict[str, bool], message: str | None, tmp_path: Path) -> None:
    """With the line, or what does not balance, and nothing is written."""
    if message is None:
        imported(tmp_path, rows, **options)
        return
    with pytest.raises(CirlError, match="(?s)" + message):
        imported(tmp_path, rows, **options)
    assert not (tmp_path / "net.toml").exists()


def contents_of(path: Path) -> dict[str, float]:
    """Return the content of each flow, without agents."""
    network = load_network(path)
    flows, substances = simulated(network)
    return dict(zip([arc.id for arc in network.arcs], (substances[0, 0] / flows[0]).tolist(), strict=True))


def test_traces_are_separated_and_balance_as_what_there_is_most_of(tmp_path: Path) -> None:
    """An amount counts by what there is of its substance, not by the flow."""
    imported(tmp_path, sorting((1e-6, 0, 1e-6)))
    contents = contents_of(tmp_path / "net.toml")
    assert contents["sorter_to_dump"] == pytest.approx(1e-7) and contents["sorter_to_product"] < 1e-15
    rows = [*sorting()[:1], ["Mine", "Dump", 2000, "", 10, "kt/year", ""]]
    rows[0][1] = "Product"
    rows += [["Mine", "Dump", 2000, "Copper", 0.09, "ppm", ""], ["Mine", "Product", 2000, "Copper", 0, "ppm", ""]]
    import_flows(table(tmp_path / "source_table.csv", rows), tmp_path / "source.toml", roles=ROLES)
    contents = contents_of(tmp_path / "source.toml")
    assert contents["mine_to_dump"] == pytest.approx(9e-8) and contents["mine_to_product"] == 0.0
    exact = [*sorting()[:3], *([*row[:6], "0"] for row in sorting((2e-6, 0, 0))[3:])]
    with pytest.raises(CirlError, match="no amounts of Copper balance"):
        import_flows(table(tmp_path / "exact_table.csv", exact), tmp_path / "exact.toml", roles=ROLES, reconcile=True)
    trace = [[*row[:3], "Tin", row[4] * 1e-9, *row[5:]] for row in sorting((5, 1, 3))[3:]]  # type: ignore[operator]
    both = table(tmp_path / "both_table.csv", [*sorting(), *trace])
    report = import_flows(both, tmp_path / "both.toml", roles=ROLES, reconcile=True)
    ore, product, dump = amounts_of(report)[1, 0, 0]
    assert ore == pytest.approx(product + dump, rel=1e-9) and 4e-9 < ore < 5e-9
    assert {change.substance for change in report.changes} == {"Tin"}


def test_a_row_has_its_own_unit(tmp_path: Path) -> None:
    """A column that is named by the unit of flows has parts of them where a row of a substance says so."""
    header = ["source", "target", "year", "substance", "kt_per_year", "unit"]
    rows = [["Mine", "Dump", 2000, "", 50, ""], ["Mine", "Dump", 2000, "Copper", 4, "%"]]
    import_flows(table(tmp_path / "flows.csv", rows, header), tmp_path / "net.toml", roles=ROLES)
    assert contents_of(tmp_path / "net.toml") == {"mine_to_dump": pytest.approx(0.04)}


def test_flows_of_a_day_are_those_of_a_year(tmp_path: Path) -> None:
    """Networks of tables have years; so have amounts of substances without a unit of their own."""
    rows = [["Mine", "Dump", 2000, "", 1, "kt/day", "0.1"], ["Mine", "Dump", 2000, "Copper", 0.04, "kt/day", ""]]
    report = imported(tmp_path, rows)
    assert report.table.unit == "kt/year" and report.table.values == pytest.approx([365.25])
    assert report.table.deviations == pytest.approx([36.525])
    assert contents_of(tmp_path / "net.toml") == {"mine_to_dump": pytest.approx(0.04)}
    bare = table(tmp_path / "bare_table.csv", [[*row[:5], "", row[6]] for row in rows])
    import_flows(bare, tmp_path / "bare.toml", roles=ROLES, unit="kt/day")
    assert contents_of(tmp_path / "bare.toml") == {"mine_to_dump": pytest.approx(0.04)}


def test_what_mixes_mixes_the_flows_that_were_adjusted(tmp_path: Path) -> None:
    """Contents of what a process hands on are those of what enters it after the flows were reconciled, too."""
    rows = sorting((4, "", ""))
    rows[0][4], rows[3][5] = 120, "%"
    report = imported(tmp_path, rows, reconcile=True)
    assert {change.substance for change in report.changes} == {""}
    assert [*contents_of(tmp_path / "net.toml").values()] == pytest.approx([0.04] * 3, rel=1e-9)


def test_regions_and_years_tell_for_themselves(tmp_path: Path) -> None:
    """What one region tells of a process is none of another's, which may be without; a year without rows is refused."""
    header = [*HEADER, "region"]
    plain, told = ([[*row, "A"] for row in rows] for rows in (sorting((4, "", "")), sorting()))
    other = [[*row[:-1], "B"] for row in told]
    without = [[*row[:-1], "C"] for row in plain[:3]]
    flows = table(tmp_path / "flows.csv", [*plain, *other, *without], header)
    report = import_flows(flows, tmp_path / "net.toml", roles=ROLES)
    expected = [[4.0, 3.6, 0.4], [4.0, 1.0, 3.0], [0.0, 0.0, 0.0]]
    np.testing.assert_allclose(amounts_of(report)[0, :, 0], expected, rtol=1e-12)
    alone = import_flows(flows, tmp_path / "alone.toml", roles=ROLES, regions=["C"])
    assert alone.table.substances is None
    later = [[*row[:2], 2001, *row[3:]] for row in sorting()[:3]]
    with pytest.raises(CirlError, match=r"no row says what there is of Copper in 2001; say it, if only that it is 0"):
        import_flows(table(tmp_path / "years_table.csv", [*sorting(), *later]), tmp_path / "years.toml", roles=ROLES)


def test_nothing_flows_with_a_content(tmp_path: Path) -> None:
    """A source that gives nothing has none; a content of a flow that is stated to be 0 says nothing."""
    rows = [*sorting(), ["Mine2", "Dump", 2000, "", 0, "kt/year", ""], ["Mine", "Dump", 2000, "", 0, "kt/year", ""]]
    rows.append(["Mine", "Dump", 2000, "Copper", 4, "%", ""])
    rows += [[*row[:2], 2001, "", 0, "kt/year", ""] for row in rows if not row[3]]
    assert imported(tmp_path, rows).content_error < 1e-9
    flows = table(tmp_path / "0.csv", sorting((0, 0, 0)))
    with pytest.raises(CirlError, match=r"0\.csv: no flow has any Copper; leave its rows out"):
        import_flows(flows, tmp_path / "none.toml", roles=ROLES)


def test_contents_that_do_not_come_back_are_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A network in which sources that differ were taken for one is not that of the table."""
    monkeypatch.setattr(definition, "ALIKE", 1e9)
    rows: list[Row] = [["Mine", end, 2000, "", 10, "kt/year", ""] for end in ("Product", "Dump")]
    rows += [["Mine", end, 2000, "Copper", part, "%", ""] for end, part in (("Product", 0), ("Dump", 4))]
    with pytest.raises(CirlError, match=r"does not give back Copper of 'Mine' to '.*' in 2000"):
        imported(tmp_path, rows)
    assert not (tmp_path / "net.toml").exists()


@pytest.mark.parametrize("name", ["Stock", "Flow"])
def test_a_substance_may_be_called_like_a_column(name: str, tmp_path: Path) -> None:
    """Stores of regions have contents and stocks, in columns of their own."""
    rows: list[Row] = []
    for region in "AB":
        for ends, flow, part in ((("Mine", "Use"), 10, 4), (("Use", "Dump"), 5, 2)):
            rows.append([*ends, 2000, "", flow, "kt/year", "", region])
            rows.append([*ends, 2000, name, part, "%", "", region])
    stocks = table(tmp_path / "stocks.csv", [["A", "Use", 1999, 100, "kt"], ["B", "Use", 1999, 200, "kt"]], STOCKS)
    flows = table(tmp_path / "flows.csv", rows, [*HEADER, "region"])
    import_flows(flows, tmp_path / "net.toml", stocks, roles=ROLES, stores=["Use"])
    store = load_network(f"{tmp_path / 'net.toml'}:b").stores[1]
    assert store.initial == (200.0, 200.0) and dict(store.content) == {name.lower(): pytest.approx(0.02)}


def test_errors_of_what_is_written_name_the_file_that_was_asked_for(tmp_path: Path) -> None:
    """Not the one beside it that is gone."""
    rows = [[*row[:3], row[3] and "Remainder", *row[4:]] for row in sorting()]
    with pytest.raises(CirlError, match=r"net\.toml: substance 'remainder': the id is that of") as failure:
        imported(tmp_path, rows)
    assert "partial" not in str(failure.value)


def test_the_command_says_what_is_in_it(tmp_path: Path) -> None:
    """How far contents are from the table, and which were adjusted."""
    path = table(tmp_path / "flows.csv", sorting((4.4, 1, 3)))
    arguments = ["import", str(path), "--out", str(tmp_path / "net.toml"), "--reservoir", "Mine", "--reconcile"]
    result = CliRunner().invoke(app, [*arguments, "--landfill", "Dump", "--landfill", "Product"])
    assert result.exit_code == 0, result.output
    assert "'Mine' to 'Sorter' (2000, Copper): 4.4 →" in result.output
    assert "simulated contents of Copper are up to" in result.output


def stored(tmp_path: Path, stocks: Sequence[Row], dumped: float = 2.0) -> ImportReport:
    """Import a use whose stocks have substances, and from which so much copper is dumped."""
    rows: list[Row] = [
        *[["Mine", "Use", 2000, name, value, "kt/year", "10 %"] for name, value in (("", 10), ("Copper", 1))],
        *[["Use", "Dump", 2000, name, value, "kt/year", "10 %"] for name, value in (("", 8), ("Copper", dumped))],
    ]
    beside = table(tmp_path / "stocks.csv", stocks, LONG)
    return imported(tmp_path, rows, stocks=beside)


@pytest.mark.parametrize(("value", "unit"), [(5, "%"), (5, "kt"), (5e3, "t"), (5e4, "ppm")])
def test_tables_of_stocks_say_what_is_in_them(tmp_path: Path, value: float, unit: str) -> None:
    """As a part or an amount; what leaves a year later, a quarter of it copper, says nothing then."""
    report = stored(tmp_path, [["Use", 1999, "Copper", value, unit], ["Use", 1999, "", 100, "kt"]])
    use = next(node for node in load_network(report.files[0]).nodes if node.id == "use")
    assert dict(use.content)["copper"] == pytest.approx(0.05, rel=1e-12)


@pytest.mark.parametrize("content", [0.05, 0.15])
def test_contents_of_stocks_are_held_against_the_simulation(tmp_path: Path, content: float) -> None:
    """Of 5 kt in 100 there are 5 + 1 - 0.4 in 102 a year later; and no flow tells of 1990."""
    stocks: list[Row] = [["Use", year, "", 100, "kt"] for year in (1990, 1999, 2000)]
    stocks += [["Use", 1999, "Copper", 5, "%"], ["Use", 2000, "Copper", content, "1"]]
    assert stored(tmp_path, stocks, dumped=0.4).content_error == pytest.approx(abs(5.6 / 102 - content), abs=3e-4)
    for path in tmp_path.glob("net.*"):
        path.unlink()
    with pytest.raises(
        CirlError, match=r"0\.04 of 'Use' in 1990 is Copper, but contents .* the end of 1999, and ends .* 2000"
    ):
        stored(tmp_path, [*stocks, ["Use", 1990, "Copper", 4, "%"]])


def test_stocks_of_some_regions_say_what_is_in_them(tmp_path: Path) -> None:
    """Where nothing is told the content is that of what leaves."""
    rows = [
        [*ends, 2000, name, value, unit, "", region]
        for region in "AB"
        for ends in (("Mine", "Use"), ("Use", "Dump"))
        for name, value, unit in (("", 10, "kt/year"), ("Copper", 2, "%"))
    ]
    stocks = [
        ["A", "Use", 1999, "", 100, "kt"],
        ["A", "Use", 1999, "Copper", 5, "%"],
        ["B", "Use", 1999, "", 900, "kt"],
    ]
    beside = table(tmp_path / "stocks.csv", stocks, ["region", *LONG])
    flows = table(tmp_path / "flows.csv", rows, [*HEADER, "region"])
    import_flows(flows, tmp_path / "net.toml", beside, roles=ROLES, stores=["Use"])
    contents = [dict(load_network(f"{tmp_path / 'net.toml'}:{region}").stores[1].content) for region in "ab"]
    assert contents == [{"copper": pytest.approx(0.05)}, {"copper": pytest.approx(0.02)}]


def test_all_of_a_stock_is_all_of_it(tmp_path: Path) -> None:
    """Whatever rounding makes of its amount; of nothing there is nothing."""
    path = table(tmp_path / "stocks.csv", [["Use", 1999, "", 0.7, "kt"], ["Use", 1999, "Copper", 700, "t"]], LONG)
    assert read_stocks(path, "kt")[1]["Copper"] == {("", "Use", 1999): 1.0}
    table(path, [["Use", 1999, "", 0, "kt"], ["Use", 1999, "Copper", 1, "kt"]], LONG)
    with pytest.raises(CirlError, match=r"line 3: 1 kt of a stock of 0"):
        read_stocks(path, "kt")


@pytest.mark.parametrize(
    ("row", "fault"),
    [
        (["Use", 1999, "Coper", 5, "%"], "stocks: unknown substance 'Coper'. Did you mean 'Copper'"),
        (["Use", 1998, "Copper", 5, "%"], r"line 3: no row says what 'Use' holds in 1998"),
        (["Use", 1999, "Copper", 120, "kt"], r"line 3: 1.2 of 'Use' is Copper"),
        (["Use", 1999, "Copper", 5, "kg/m"], r"line 3: .* give a part"),
        (["Use", 1999, "Copper", 5, "kt/year"], r"line 3: .* an amount in kt"),
        (["Use", 1999, "Copper", 5, ""], r"line 3: no unit"),
        (
            ["Mine", 1999, "Copper", 5, "%"],
            r"stocks\.csv: 0\.05 of 'Mine' in 1999 is Copper, but it is a source, and has",
        ),
        (["Dump", 1999, "Copper", 5, "%"], r"stocks\.csv: 0\.05 of 'Dump' in 1999 is Copper, but it is a sink, and is"),
    ],
)
def test_what_is_wrong_with_substances_in_stocks(tmp_path: Path, row: Row, fault: str) -> None:
    """The line is named, and the nearest substance."""
    with pytest.raises(CirlError, match=fault):
        stored(tmp_path, [["Use", 1999, "", 100, "kt"], row, *([end, 1999, "", 100, "kt"] for end in ("Mine", "Dump"))])


def test_stocks_of_sources_that_are_several_are_refused(tmp_path: Path) -> None:
    """What leaves a mine in two contents comes from two of them, and nobody said how its stock is divided."""
    rows: list[Row] = [["Mine", end, 2000, "", 10, "kt/year", ""] for end in ("Product", "Dump")]
    rows += [["Mine", end, 2000, "Copper", part, "%", ""] for end, part in (("Product", 0), ("Dump", 4))]
    stocks = table(tmp_path / "stocks.csv", [["Mine", 1999, "", 100, "kt"]], LONG)
    with pytest.raises(CirlError, match="stocks: what leaves 'Mine' differs in content"):
        imported(tmp_path, rows, stocks=stocks)
