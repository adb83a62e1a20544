"""Reports in a real Chromium, driven by Playwright; without one these tests are left out, which is said at the end."""

from __future__ import annotations

import csv
import io
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pages import COMPUTED, HOSTILE, bottles_at, shown, world

from cirl_marl import load_network
from cirl_marl.evaluation.simulations import Simulation, simulate_alternatives
from cirl_marl.evaluation.statistics import Aggregate
from cirl_marl.report.page_html import write_page
from cirl_marl.report.report_page import PLAN, PlanePoint, ReportPage, page_of_alternatives

ROOT = Path(__file__).parent.parent
NEEDED = "a browser: Playwright of the extra 'browser', and Chromium (apt-get install chromium)"
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip

pytestmark = pytest.mark.medium


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """Return a browser, or leave the test out."""
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        pytest.skip(f"needs {NEEDED}")
    if path is None:
        pytest.skip(f"needs {NEEDED}")
    # the driver asks for no browser of its own and reports nothing
    os.environ.setdefault("PLAYWRIGHT_SKIP_BROWSER_DOWNLOAD", "1")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, headless=True, args=FLAGS)
        yield browser
        browser.close()


@dataclass
class Opened:
    """A page, and what it did that it should not."""

    page: Any
    requests: list[str] = field(default_factory=list)
    said: list[str] = field(default_factory=list)

    def texts(self, where: str) -> list[str]:
        """Return the texts of all elements that a selector finds."""
        return [str(each) for each in self.page.locator(where).all_text_contents()]

    def widths(self, kind: str = "line") -> list[float]:
        """Return the widths of all ribbons, pixels of the diagram."""
        found = self.page.eval_on_selector_all(
            f".ribbon .{kind}", "all => all.map(e => +e.getAttribute('stroke-width'))"
        )
        return [float(each) for each in found]

    def flows(self) -> list[float]:
        """Return the flows that the diagram tells."""
        return [
            float(each) for each in self.page.eval_on_selector_all(".ribbon", "all => all.map(e => e.dataset.flow)")
        ]

    def downloaded(self) -> list[dict[str, str]]:
        """Return the rows of the CSV file that the page gives."""
        with self.page.expect_download() as download:
            self.page.get_by_role("button", name="Download everything as CSV").click()
        return list(csv.DictReader(io.StringIO(Path(download.value.path()).read_text(encoding="utf-8"))))


@pytest.fixture
def opened(chromium: Any, request: pytest.FixtureRequest) -> Iterator[Any]:
    """Return what opens a file; at the end no page may have asked for anything but itself, or said anything."""
    pages: list[tuple[Path, Opened]] = []

    def open_(path: Path, **context: Any) -> Opened:
        settings = {"viewport": {"width": 1280, "height": 900}, "reduced_motion": "reduce"} | context
        found = Opened(chromium.new_context(**settings).new_page())
        found.page.on("request", lambda each: found.requests.append(each.url))
        found.page.on("console", lambda each: found.said.append(each.text))
        found.page.on("pageerror", lambda each: found.said.append(str(each)))
        found.page.goto(path.as_uri())
        pages.append((path, found))
        return found

    yield open_
    for path, found in pages:
        asked, said = list(found.requests), list(found.said)
        found.page.context.close()
        assert asked == [path.as_uri()]
        assert said == []


def two(folder: Path, **options: Any) -> list[Simulation]:
    """Return two courses of the small network of the guide."""
    return simulate_alternatives(bottles_at(folder, **options), controls=["neutral", "random"])


def test_the_slider_moves_flows_to_the_numbers_of_the_csv(tmp_path: Path, opened: Any) -> None:
    """By keyboard: at each step ribbons, boxes, table and file tell what was simulated; widths are in proportion."""
    found = two(tmp_path)
    path = write_page(tmp_path / "page.html", page_of_alternatives(found))
    scale = shown(path.read_text(encoding="utf-8"))["networks"][0]["sketches"][0]["ways"]["lying"]["scale"]
    tab = opened(path)
    random = found[1].rollout
    slider = tab.page.locator("#time")
    slider.focus()
    for key, step in (("Home", 1), ("ArrowRight", 2), ("ArrowRight", 3), ("End", 12), ("ArrowLeft", 11)):
        slider.press(key)
        assert tab.page.locator("#now").inner_text() == slider.get_attribute("aria-valuetext") == f"day {step}"
        np.testing.assert_allclose(tab.flows(), random.flow[step - 1], rtol=1e-5)
        widths = tab.widths()
        np.testing.assert_allclose(widths, random.flow[step - 1] * scale, atol=0.01)
        boxes = tab.page.eval_on_selector_all(".box", "all => all.map(e => e.getAttribute('aria-label'))")
        assert boxes[1] == f"households, holds {random.stock[step - 1, 1]:.3g}\u00a0t"
    tab.page.locator("#kind").select_option("flow")
    cells = tab.texts("#figures tbody tr:first-child td")
    assert cells == ["t/day", *(f"{each.rollout.flow[10, 0]:.3g}" for each in found)]
    rows = tab.downloaded()
    for each in found:
        for k, arc in enumerate(each.network.arcs):
            told = [float(r["value"]) for r in rows if (r["scene"], r["kind"], r["id"]) == (each.name, "flow", arc.id)]
            np.testing.assert_allclose(told, each.rollout.flow[:, k], rtol=1e-5)
        stocks = [r for r in rows if (r["scene"], r["kind"], r["id"]) == (each.name, "stock", "households")]
        assert (stocks[0]["when"], stocks[0]["unit"], len(stocks)) == ("start", "t", 13)
        acts = [r for r in rows if (r["scene"], r["kind"], r["id"]) == (each.name, "control", "disposal")]
        np.testing.assert_allclose([float(r["value"]) for r in acts], each.rollout.controls[:, 1], rtol=1e-5)


def test_colours_show_contents(tmp_path: Path, opened: Any) -> None:
    """Where one is chosen: legend, boxes, ribbons and what is said of them; else colours are those of roles."""
    simulations = simulate_alternatives("examples/copper_in_steel.toml", controls=["neutral"], steps=3)
    page = opened(write_page(tmp_path / "steel.html", page_of_alternatives(simulations))).page
    colours = "all => all.map(e => getComputedStyle(e).stroke)"
    own = page.eval_on_selector_all(".ribbon .line", colours)
    (rejects,) = page.locator("figcaption", has_text="share of copper in shredder").all()
    assert rejects.inner_text().endswith("\n30.0\u00a0%")
    page.select_option("#tint", "copper")
    assert len(set(page.eval_on_selector_all(".ribbon .line", colours))) > len(set(own))
    steps = page.locator("#legend li").all_text_contents()
    assert steps == ["copper: 0 %", "0.1 %", "0.2 %", "0.3 %", "0.4 % or more", "nothing"]
    wires = page.locator(".box", has_text="wires")
    assert ", copper 100\u00a0%" in wires.get_attribute("aria-label")
    wires.focus()
    assert page.locator("#details td[data-column='copper']").all_text_contents() == ["100\u00a0%"]
    page.select_option("#tint", "")
    assert page.eval_on_selector_all(".ribbon .line", colours) == own
    assert "copper" not in wires.get_attribute("aria-label")


def test_hostile_texts_are_texts(tmp_path: Path, opened: Any) -> None:
    """Titles and sources that would run, end an element or compute in a spreadsheet stand there as they are."""
    tab = opened(write_page(tmp_path / "page.html", page_of_alternatives(two(tmp_path, hostile=True))))
    assert tab.page.locator("#title").text_content() == HOSTILE == tab.page.title().replace("\n", "\u2028")
    assert tab.page.locator("script").count() == 2 and tab.page.locator("img").count() == 0
    tab.page.locator(".ribbon").first.focus()
    assert HOSTILE in tab.texts("#details dd") and HOSTILE in tab.page.locator("#details h3").text_content()
    (name,) = {row["name"] for row in tab.downloaded() if row["kind"] == "stock" and row["id"] == "quarry"}
    assert name == f"'{COMPUTED}"


def test_keyboard_and_screen_readers(tmp_path: Path, opened: Any) -> None:
    """One stop for the picture, arrows within; what is reached is told with value, unit, share and source."""
    found = two(tmp_path)
    tab = opened(write_page(tmp_path / "page.html", page_of_alternatives(found)))
    page = tab.page
    for role, name in (("slider", "Time"), ("button", "Play"), ("radio", "random"), ("listbox", "Network, random")):
        assert page.get_by_role(role, name=name, exact=True).count() == 1, name
    pictures = page.eval_on_selector_all("svg[role=img]", "all => all.map(e => e.getAttribute('aria-label'))")
    assert any(each.startswith("Circularity λ, t, day 1 to day 12: neutral from −") for each in pictures)
    assert page.locator("[role=option][tabindex='0']").count() == 1
    page.locator("[role=option][tabindex='0']").focus()
    for _ in range(3):
        page.keyboard.press("ArrowRight")
    reached = page.evaluate("document.activeElement.getAttribute('aria-label')")
    assert reached == f"glassworks, from quarry to households, {found[1].rollout.flow[0, 0]:.3g}\u00a0t/day"
    told = page.locator("#details").inner_text()
    for word in (
        "lowers λ",
        "Law donor",
        "t/day",
        "100\u00a0%",
        "5 t/d of 10 000 t",
        "0.0005 1/day",
        "neutral",
        "random",
    ):
        assert word in told, word
    page.keyboard.press("End")
    assert "a bottle lives 20 days" in page.locator("#details").inner_text()
    page.get_by_role("radio", name="side by side").check(force=True)
    assert page.get_by_role("listbox").count() == 2
    page.locator("#time").focus()
    page.keyboard.press("End")
    assert page.get_by_role("button", name="Play").get_attribute("aria-label") == "Play"
    page.locator("#play").press("Enter")
    page.get_by_text("day 2", exact=True).wait_for()
    page.get_by_role("button", name="Pause").press("Enter")
    assert 2 <= int(page.locator("#time").input_value()) < 12


def test_phone_dark_and_motion(tmp_path: Path, opened: Any) -> None:
    """A phone's width is enough, the diagram stands; dark is dark; with motion widths glide to the same value."""
    found = two(tmp_path)
    path = write_page(tmp_path / "page.html", page_of_alternatives(found))
    phone = opened(path, viewport={"width": 360, "height": 740}, color_scheme="dark", has_touch=True)
    assert phone.page.evaluate("document.documentElement.scrollWidth") == 360
    tops = phone.page.eval_on_selector_all(".box .body", "all => all.map(e => e.getBoundingClientRect().top)")
    assert tops[0] < tops[1] < tops[2]
    assert phone.page.locator("svg[role=listbox]").bounding_box()["width"] <= 360
    wide = opened(path, reduced_motion="no-preference")
    lefts = wide.page.eval_on_selector_all(".box .body", "all => all.map(e => e.getBoundingClientRect().left)")
    assert lefts[0] < lefts[1] < lefts[2]
    light, dark = (
        sum(map(int, each.page.evaluate("getComputedStyle(document.body).backgroundColor")[4:-1].split(",")))
        for each in (wide, phone)
    )
    assert light > 720 and dark < 120
    wide.page.locator("#time").press("End")
    wide.page.wait_for_timeout(600)
    still = opened(path)
    still.page.locator("#time").press("End")
    np.testing.assert_allclose(wide.widths(), still.widths(), atol=0.02)


def test_phones_show_all_of_a_wide_network_and_of_its_figures(tmp_path: Path, opened: Any) -> None:
    """No figure of the outcome is cut; the diagram opens whole, and large around its broadest box at a button."""
    found = page_of_alternatives(simulate_alternatives("steel_japan", steps=2))
    names = ("circularity", "gain", "service", "bound", "gap")
    figures = {name: Aggregate(-91166.0 if name in ("circularity", "bound") else 0.9, -92e3, 0.95) for name in names}
    story = replace(found, episodes=tuple(replace(each, figures=figures) for each in found.episodes))
    tab = opened(write_page(tmp_path / "page.html", story), viewport={"width": 390, "height": 844}, has_touch=True)
    page, diagram = tab.page, tab.page.locator("svg[role=listbox]")
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    cells = page.locator("#outcome-table td")
    assert cells.count() == len(names) and page.locator("#outcome-table td >> nth=0").get_attribute("data-column")
    spans = [cells.nth(i).bounding_box() for i in range(cells.count())]
    assert all(span["x"] >= 0 and span["x"] + span["width"] <= 390 for span in spans)
    assert page.evaluate("(e => e.scrollWidth <= e.clientWidth)(document.getElementById('outcome-table'))")
    whole = diagram.bounding_box()
    assert whole["x"] >= 0 and whole["x"] + whole["width"] <= 390
    page.get_by_role("button", name="Enlarge").click()
    assert diagram.bounding_box()["width"] > 1.2 * whole["width"]
    widths = page.eval_on_selector_all(".box .body", "all => all.map(e => e.getBoundingClientRect().width)")
    broadest = page.locator(".box .body").nth(int(np.argmax(widths))).bounding_box()
    assert 0 <= broadest["x"] + broadest["width"] / 2 <= 390
    page.get_by_role("button", name="Show all of it").click()
    assert diagram.bounding_box()["width"] == whole["width"]
    small = write_page(tmp_path / "small.html", page_of_alternatives(two(tmp_path)))
    assert opened(small, viewport={"width": 390, "height": 844}).page.locator(".size").count() == 0


def test_groups_points_and_plans(tmp_path: Path, opened: Any) -> None:
    """A world opens on its countries and one unfolds and folds again; a plan is what λ is held against; points."""
    story = page_of_alternatives(simulate_alternatives(world(), controls=["neutral", "random"]))
    points = (PlanePoint("plans", 0.9, -2.0, "first"), PlanePoint("plans", 0.95, -3.0))
    usual, plan = story.episodes
    front = np.array([[0.9, -1.0], [1.0, -1.5]])
    scenes = (replace(usual, figures={"bound": Aggregate(-0.5, -0.6, -0.4)}), replace(plan, name=PLAN))
    path = write_page(tmp_path / "w.html", replace(story, episodes=scenes, points=points, front=front))
    tab = opened(path)
    page = tab.page
    assert page.locator(".box").count() == 6
    page.locator(".box.folded").nth(2).press("Enter")
    assert page.locator(".box").count() == 18 and page.locator("#path").inner_text().endswith("Country 2")
    page.get_by_role("button", name="All groups").click()
    assert page.locator(".box").count() == 6
    assert tab.texts("figcaption strong")[:3] == [
        "Circularity λ",
        f"λ behind the {PLAN}",
        "λ behind the bound on its mean",
    ]
    tab.page.locator("#time").press("End")
    behind = [tab.texts(f"#curves figure:nth-of-type({i}) .values .figure") for i in (2, 3)]
    last, best = (float(episode.bands["circularity"][0].value[-1]) for episode in (usual, plan))
    assert [[float(text.replace("−", "-")) for text in each] for each in behind] == [
        [pytest.approx(best - last, rel=0.01)],
        [pytest.approx(-0.5 - last, rel=0.01)],
    ]
    assert tab.texts("#plane-chart title") == [
        "plans, first: λ̄ −2 kg, service 90.0\u00a0%",
        "plans: λ̄ −3 kg, service 95.0\u00a0%",
    ]
    bare = opened(write_page(tmp_path / "p.html", ReportPage("points", story.network, points=points, front=front)))
    assert not bare.page.locator("#network").is_visible() and not bare.page.locator("#timed").is_visible()
    assert len(bare.texts("#figures tbody tr")) == 4
    assert [row["value"] for row in bare.downloaded() if row["scene"] == "plans"] == ["0.9", "-2", "0.95", "-3"]


SEARCHED = """\
INHERIT: {mkdocs}
docs_dir: {docs}
plugins: [search, offline]
hooks: []
extra_css: []
nav: [{{First: first.md}}, {{Second: second.md}}]
"""


@pytest.mark.slow
def test_a_site_is_searched_from_a_disk(tmp_path: Path, chromium: Any) -> None:
    """With our theme, plugins and script, a word leads to its page without a server, and nothing is fetched."""
    pytest.importorskip("material", reason="needs the extra 'docs'")
    docs = tmp_path / "docs"
    (docs / "docs" / "site").mkdir(parents=True)
    (docs / "first.md").write_text("# First\n\nNothing of note.\n")
    (docs / "second.md").write_text("# Second\n\nThe quokka is here.\n")
    script = "docs/site/iframe-worker.js"
    (docs / script).write_text((ROOT / script).read_text())
    config = tmp_path / "mkdocs.yml"
    config.write_text(SEARCHED.format(mkdocs=ROOT / "mkdocs.yml", docs=docs))
    command = [sys.executable, "-m", "mkdocs", "build", "-q", "-f", str(config), "-d", str(tmp_path / "site")]
    run = subprocess.run(command, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    page, requests = chromium.new_page(), list[str]()
    page.on("request", lambda request: requests.append(request.url))
    page.goto((tmp_path / "site" / "first.html").as_uri())
    page.locator(".md-search__input").click()
    page.locator(".md-search__input").press_sequentially("quokka")
    page.locator(".md-search-result__link").first.click()
    page.wait_for_url("**/second.html*")
    page.close()
    assert all(request.startswith(("file:", "data:", "about:")) for request in requests)


@pytest.mark.slow
def test_a_country_is_light_and_fast(tmp_path: Path, opened: Any) -> None:
    """The steel of Japan takes less than 2 MB and 2 s to the first picture."""
    network = load_network("steel_japan")
    path = write_page(
        tmp_path / "steel.html", page_of_alternatives(simulate_alternatives(network, controls=["neutral", "random"]))
    )
    assert path.stat().st_size < 2e6
    tab = opened(path)
    assert tab.page.locator(".ribbon").count() == len(network.arcs)
    drawn = tab.page.evaluate("performance.getEntriesByType('navigation')[0].loadEventEnd")
    assert 0 < drawn < 2000, "the script has run when a page is loaded"


@pytest.mark.slow
def test_a_world_is_light_enough(tmp_path: Path, opened: Any) -> None:
    """Five hundred nodes take less than 5 MB."""
    network = world(countries=31, horizon=26)
    path = write_page(
        tmp_path / "w.html", page_of_alternatives(simulate_alternatives(network, controls=["neutral", "random"]))
    )
    assert len(network.nodes) == 498 and path.stat().st_size < 5e6
    assert opened(path).page.locator(".box").count() == 33
