"""Pictures: they exist, show what changed, leave matplotlib's settings alone and keep labels apart."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import imread
from numpy.typing import NDArray
from small_networks import ONE_OF_EACH

import cirl_marl
from cirl_marl import Arc, CirlError, Network, Node, Role
from cirl_marl.drawing import picture as drawing
from cirl_marl.drawing.digraph import Canvas, draw_network, save_before_after, save_network
from cirl_marl.drawing.digraph_layout import digraph_layout
from cirl_marl.drawing.picture import legend_of
from cirl_marl.network import Floats
from cirl_marl.report import curves
from cirl_marl.report.curves import PointSeries, _by_scale, save_circularity, save_learning_curves, save_trajectory

Picture = NDArray[np.float32]


@pytest.fixture(scope="module", autouse=True)
def coarse_pictures() -> None:
    """Write pictures as fine as they are."""


def read(path: Path) -> Picture:
    """Return a PNG that must not be blank."""
    assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    image: Picture = imread(path)
    height, width = image.shape[:2]
    assert 1500 <= width <= 2000
    assert 400 <= height <= 2400
    assert 0.005 < float((image[..., :3].min(axis=-1) < 0.97).mean()) < 0.9
    return image


def some_flows(network: Network) -> tuple[Floats, Floats]:
    """Return stocks and flows of a plausible size."""
    random = np.random.default_rng(3)
    stock = np.array([node.scale for node in network.nodes]) * random.uniform(0, 2, len(network.nodes))
    return stock, np.array([arc.scale for arc in network.arcs]) * random.uniform(0, 1, len(network.arcs))


def random_network(nodes: int, arcs: int) -> Network:
    """Return a network with one reservoir, one landfill and cycles, loops through two nodes included."""
    random = np.random.default_rng(0)
    pairs = {(int(random.integers(0, i)), i) for i in range(1, nodes)}
    while len(pairs) < arcs:
        donor, recipient = (int(i) for i in random.integers(1, nodes - 1, 2))
        if donor != recipient:
            pairs |= {(donor, recipient), (recipient, donor)}
    roles = {0: Role.NONRENEWABLE_RESERVOIR, nodes - 1: Role.LANDFILL}
    return Network(
        name="random",
        nodes=tuple(
            Node(id=f"node_{i}", role=roles.get(i, Role.TECHNOSPHERE), initial=(0.0, 0.0)) for i in range(nodes)
        ),
        arcs=tuple(
            Arc(id=f"arc_{k}", donor=f"node_{i}", recipient=f"node_{j}", rate=0.1)
            for k, (i, j) in enumerate(sorted(pairs))
        ),
    )


@pytest.fixture(autouse=True)
def _settings_untouched() -> Iterator[None]:
    """Every picture leaves matplotlib's settings, backend and figures as they were."""
    before = dict(matplotlib.rcParams)
    yield
    assert dict(matplotlib.rcParams) == before
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or not pyplot.get_fignums()


@pytest.mark.sample(1)
@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_catalogue_is_readable(name: str) -> None:
    """No box or label hides another; but for networks of more than twenty arcs no arrow passes behind a box."""
    network = cirl_marl.load_network(name)
    for aspect in (0.9, 1.6):
        layout = digraph_layout(network, aspect)
        assert layout.routes is not None
        for one, two in combinations(layout.positions, 2):
            assert (np.abs(one - two) > layout.box).any()
        for arc, label in enumerate(layout.routes.labels):
            text = np.array([2.6, 1.0])
            assert (np.abs(layout.positions - label) > (layout.box + text) / 2).any(axis=1).all()
            others = np.delete(layout.routes.labels, arc, axis=0)
            assert (np.abs(others - label) > text).any(axis=1).all()
        if len(network.arcs) > 20:
            continue
        for curve, donor, recipient in zip(layout.routes.curves, network.donors, network.recipients, strict=True):
            others = np.delete(layout.positions, [donor, recipient], axis=0)
            assert (np.abs(curve[:, None] - others) > layout.box / 2).any(axis=-1).all()


@pytest.mark.sample(1)
@pytest.mark.parametrize("size", [(2, 1), (3, 2), (9, 16), (20, 40), (50, 90), (2000, 4000)])
@pytest.mark.medium
def test_networks_of_any_size(tmp_path: Path, size: tuple[int, int]) -> None:
    """A digraph is drawn from a pair of nodes to thousands."""
    network = random_network(*size)
    path = tmp_path / "folder" / "network.png"
    stock, flow = some_flows(network)
    assert save_network(path, network, stock, flow, title="one") == path
    read(path)
    assert [found.name for found in path.parent.iterdir()] == ["network.png"]


@pytest.mark.medium
@pytest.mark.parametrize("nodes", [7, 300])
def test_long_chain_and_ring(tmp_path: Path, nodes: int) -> None:
    """A ring without sources and a chain are drawn too."""
    ring = [(i, (i + 1) % nodes) for i in range(nodes)]
    for pairs in (ring, ring[:-1]):
        network = Network(
            name="ring",
            nodes=tuple(Node(id=f"n{i}", initial=(0.0, 0.0)) for i in range(nodes)),
            arcs=tuple(Arc(id=f"a{i}", donor=f"n{i}", recipient=f"n{j}", rate=0.1) for i, j in pairs),
        )
        positions = digraph_layout(network, 1.4).positions
        assert len(np.unique(positions, axis=0)) == nodes
        width, height = np.ptp(positions, axis=0)
        assert 0.3 < width / max(height, 1.0) < 12
        save_network(tmp_path / "ring.png", network, *some_flows(network))
        read(tmp_path / "ring.png")


def test_opposite_arcs_keep_apart() -> None:
    """Two arcs between the same compartments bend to opposite sides."""
    network = cirl_marl.load_network("carbo_net")
    routes = digraph_layout(network, 1.4).routes
    assert routes is not None
    there, back = (routes.curves[network.arc_index[arc]] for arc in ("urban_to_adjacent", "adjacent_to_urban"))
    assert np.hypot(*(there[:, None] - back).T).min() > 1.5


@pytest.mark.medium
def test_before_and_after(tmp_path: Path) -> None:
    """Two states stand side by side, with the wider arrow where the flow is larger."""
    network = cirl_marl.load_network("carbo_net")
    stock, flow = some_flows(network)
    path = save_before_after(tmp_path / "two.png", network, (stock, flow), (stock, 0.2 * flow), ("now", "then"))
    image = read(path)[..., :3]
    vermilion = np.abs(image - np.array([0xD5, 0x5E, 0x00]) / 255).max(axis=-1) < 0.05
    half = image.shape[1] // 2
    assert vermilion[:-200, :half].sum() > 1.5 * vermilion[:-200, half:].sum() > 0


def test_title_tells_circularity() -> None:
    """λ of the flows and its unit stand above the digraph; the text of an axes is its own."""
    network = cirl_marl.load_network("copper_net")
    axes = Figure().add_axes((0, 0, 1, 0.9))
    draw_network(axes, network, np.zeros(8), np.full(9, 46.8), title="copper")
    texts = [text.get_text() for text in axes.texts]
    assert "copper" in texts
    assert any(text.startswith("λ = −93.6 kt ") for text in texts)
    assert texts.count("46.8") == 9


def test_batches_count_in_the_title(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where batches move, a rendered frame shows the λ of the infos; flows alone tell none."""
    env = cirl_marl.parallel_env("solids_net", scenario="reacher", render_mode="rgb_array")
    env.reset(seed=0)
    shown: list[float | None] = []
    monkeypatch.setattr(drawing, "_write_title", lambda axes, network, value, title: shown.append(value))
    told = []
    for _ in range(60):
        _, _, _, _, infos = env.step(env.neutral_action)
        told.append(infos["sorter"]["circularity"])
        if told[-1] != 0.0:
            break
    env.render()
    assert shown == [pytest.approx(told[-1])] != [0.0]
    network = env.network
    draw_network(Figure().add_axes((0, 0, 1, 0.9)), network, np.zeros(len(network.nodes)), np.zeros(len(network.arcs)))
    assert shown[1] is None


def test_overflow_is_drawn(tmp_path: Path) -> None:
    """A simulation that diverged can still be looked at."""
    network = cirl_marl.load_network("copper_net")
    stock, flow = some_flows(network)
    stock[:2], flow[:2] = (np.nan, -5.0), (np.inf, np.nan)
    read(save_network(tmp_path / "diverged.png", network, stock, -flow))


def test_wrong_shapes_are_named(tmp_path: Path) -> None:
    """Arrays that do not fit are refused with their shape, and nothing is written."""
    network, path = cirl_marl.load_network("copper_net"), tmp_path / "no.png"
    with pytest.raises(CirlError, match=r"stock has shape \(9,\), expected \(8,\)"):
        save_network(path, network, np.zeros(9), np.zeros(9))
    with pytest.raises(CirlError, match=r"flow has shape \(4, 9\), expected \(9,\)"):
        save_network(path, network, np.zeros(8), np.zeros((4, 9)))
    assert not list(tmp_path.iterdir())


def test_render_is_deterministic_and_follows_the_state() -> None:
    """render() gives the same picture for the same state, another for another, and keeps its size."""
    frames = []
    for _ in range(2):
        env = cirl_marl.parallel_env("copper_net", render_mode="rgb_array")
        env.reset(seed=0)
        first = env.render()
        env.step(env.neutral_action)
        second = env.render()
        env.close()
        assert first is not None
        assert second is not None
        frames.append((first, second))
    (first, second), again = frames
    assert first.dtype == np.uint8
    assert first.ndim == 3
    assert first.shape[2] == 3
    assert first.shape == second.shape
    assert not np.array_equal(first, second)
    assert np.array_equal(first, again[0])
    assert np.array_equal(second, again[1])


def test_frames_share_no_memory() -> None:
    """A frame does not change when the next is drawn."""
    network = cirl_marl.load_network("carbo_net")
    canvas = Canvas(network, window=False)
    stock, flow = some_flows(network)
    frame = canvas.draw(stock, flow, 0.0)
    kept = frame.copy()
    assert not np.array_equal(canvas.draw(0 * stock, 0 * flow, 1.0), frame)
    assert np.array_equal(frame, kept)
    assert np.array_equal(canvas.draw(stock, flow, 0.0), kept)


# pygame imports pkg_resources, which is deprecated.
@pytest.mark.medium
@pytest.mark.filterwarnings("ignore:pkg_resources is deprecated:UserWarning")
@pytest.mark.filterwarnings("ignore:pkg_resources is deprecated:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:Deprecated call to `pkg_resources:DeprecationWarning")
def test_window(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A window shows the picture, without a word on stdout, and opens again after it was closed."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = cirl_marl.parallel_env("copper_net", render_mode="human")
    for _ in range(2):
        env.reset(seed=0)
        assert env.render() is None
        env.step(env.neutral_action)
        assert env.render() is None
        env.close()
    assert capsys.readouterr().out == ""


def test_window_needs_pygame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without pygame the error names the extra."""
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = cirl_marl.parallel_env("copper_net", render_mode="human")
    with pytest.raises(CirlError, match=r"cirl-marl\[human\]"):
        env.reset(seed=0)


@pytest.mark.parametrize("episodes", [1, 12])
@pytest.mark.medium
@pytest.mark.sample(1)
def test_circularity_curves(tmp_path: Path, episodes: int) -> None:
    """λ and service are drawn for any number of episodes, and for a single step."""
    random = np.random.default_rng(0)
    for steps in (1, 40):
        plain, shape = cirl_marl.simulate("copper_net", steps=steps), (episodes, steps)
        runs = {
            name: replace(plain.rollout, circularity_mean=random.normal(-90, 5, shape), service=random.random(shape))
            for name in ("trained", "neutral", "random")
        }
        read(save_circularity(tmp_path / "λ.png", plain.network, runs))


@pytest.mark.sample(1)
@pytest.mark.parametrize("agents", [0, 1, 2, 7, 20, 33])
@pytest.mark.medium
def test_learning_curves(tmp_path: Path, agents: int) -> None:
    """Any number of agents and of episodes, none included."""
    random = np.random.default_rng(0)
    for episodes in (0, 1, 3, 200) if agents < 3 else (200,):
        steps = np.linspace(0.0, 160.0 * episodes, episodes)
        returns = {f"use_to_collection_{i}": random.normal(0, 1, episodes) for i in range(agents)}
        path = save_learning_curves(tmp_path / "curves.png", steps, returns)
        assert path.is_file()
        if agents:  # without any, the picture is blank
            read(path)


@pytest.mark.medium
@pytest.mark.sample(2)
@pytest.mark.parametrize("network", [lambda: cirl_marl.load_network("copper_net"), lambda: random_network(40, 90)])
@pytest.mark.parametrize("steps", [1, 60])
def test_trajectory(tmp_path: Path, network: Callable[[], Network], steps: int) -> None:
    """Stocks, flows and λ are drawn over time, for few compartments and many."""
    simulation, random = cirl_marl.simulate(network(), steps=steps), np.random.default_rng(0)
    run = simulation.rollout
    stock, flow = (random.normal(size, 5, part.shape) for size, part in ((100, run.stock), (10, run.flow)))
    read(save_trajectory(tmp_path / "path.png", replace(simulation, rollout=replace(run, stock=stock, flow=flow))))


@pytest.mark.medium
def test_stocks_are_drawn_from_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not from the end of the first step; a large reserve in a panel of its own, where its change shows."""
    lines: dict[str, tuple[Floats, Floats]] = {}
    plot = Axes.plot

    def recorded(self: Axes, x: Floats, y: Floats, *args: Any, **options: Any) -> Any:
        lines[str(options.get("label"))] = np.asarray(x), np.asarray(y)
        return plot(self, x, y, *args, **options)

    monkeypatch.setattr(Axes, "plot", recorded)
    simulation = cirl_marl.simulate("copper_net", steps=3)
    stock = np.random.default_rng(0).normal(100, 5, (3, 8))
    stock[:, 0] = [1e6 - 5, 1e6 - 10, 1e6 - 15]
    start = np.full(8, 100.0)
    start[0] = 1e6
    run = replace(simulation.rollout, stock=stock, start=start)
    read(save_trajectory(tmp_path / "path.png", replace(simulation, rollout=run)))
    label = simulation.network.nodes[0].label
    np.testing.assert_allclose(lines[label][0], [0.0, 0.25, 0.5, 0.75])
    np.testing.assert_allclose(lines[label][1], 1e6 - np.array([0.0, 5.0, 10.0, 15.0]))


def test_smoothing_heeds_what_there_is() -> None:
    """A moving average is that of the finite values in its window, whatever the size of others."""
    values = np.array([1.0, 2.0, np.nan, 4.0, -1e17, 3.0, 3.0, 3.0, 3.0])
    smoothed = curves._moving_average(values, 3)
    np.testing.assert_allclose(smoothed[:3], [1.5, 1.5, 3.0])
    np.testing.assert_allclose(smoothed[6:], 3.0)


def test_stocks_stand_beside_such_as_them() -> None:
    """Ten times smaller ones have a panel of their own; there are three at most."""
    assert _by_scale(np.array([1e6, 5.0, 3e5, 7.0, 2e3, 0.0])) == [[0, 2], [4], [1, 3, 5]]
    assert _by_scale(np.array([3.0, 2.0])) == [[0, 1]]
    assert _by_scale(np.zeros(0)) == [[]]


def test_what_lies_close_together_does_not_fill_a_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two points of service and 5 % of λ̄ are shown at the least, and numbers on the axes are whole."""
    figures: list[Figure] = []

    def kept(figure: Figure, path: Path) -> Path:
        figures.append(figure)
        return path

    monkeypatch.setattr(curves, "save", kept)
    network = cirl_marl.load_network("copper_net")
    points = PointSeries("one", np.array([0.99, 0.99]), np.array([-15.0, -15.0000001]))
    curves.save_fronts(tmp_path / "x.png", network, [points], np.empty((0, 2)), title="")
    (axes,) = figures[0].axes
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    assert right - left >= 0.02 - 1e-9 and high - low >= 0.7
    figures[0].canvas.draw()
    assert not axes.yaxis.get_major_formatter().get_offset()


def test_the_legend_says_what_width_and_fill_mean() -> None:
    """The widest arrow's flow, and the reference that fills half a box."""
    network = cirl_marl.load_network("copper_net")
    labels = [handle.get_label() for handle in legend_of(network, 86.8)["handles"]]
    assert labels[-2:] == ["widest arrow: 86.8 kt/day", "half full: the reference stock or flow"]
