"""What the commands share: the application, consoles, options, progress bars."""

from __future__ import annotations

import os
import sys
import time as clock
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from rich.console import Console

from cirl_marl.definitions.code_permission import code_allowed
from cirl_marl.errors import CirlError

if TYPE_CHECKING:
    from cirl_marl.jobs import JobStatus
    from cirl_marl.network import Network
    from cirl_marl.report.presentation import Reportable

NETWORKS, EPISODES, LEARNERS, COMPARISONS = "Networks", "Episodes and plans", "Learners", "Comparisons"
"""Groups of commands in ``cirl --help``."""
EXAMPLES = """
For example: cirl new my.toml · cirl plan my.toml --control optimum --min-service 1 ·
cirl train copper_net --seed 0 · cirl report RUN --html page.html
"""
# Written out, as the modules that know them take longer to import than all else of ``cirl --help``; a test compares.
CONTROLLERS = (
    "neutral, constant, random, scripted, lqr, mpc, optimum, scenario_mpc, best_constant, best_schedule, price_policy"
)
REWARDS = "local, circularity, mixed, difference, mixed_difference, local_sum, team"
LINE_SECONDS = 30.0
"""Between two lines of progress without a terminal."""
OBSERVE = "local, neighbours, full, stocks, model"
T = TypeVar("T")

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    epilog=EXAMPLES,
)
# without emoji=False rich prints a flag or a map for the region of FILE.toml:japan:
console = Console(width=None if sys.stdout is not None and sys.stdout.isatty() else 140, emoji=False)
errors = Console(stderr=True, emoji=False)


def _print_version(version: bool) -> None:
    if version:
        console.print(f"cirl_marl {metadata.version('cirl-marl')}", highlight=False)
        raise typer.Exit


@app.callback()
def everywhere(
    context: typer.Context,
    allow_code: Annotated[
        bool, typer.Option("--allow-code", help="Let definitions import the models of their own that they name.")
    ] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Material networks whose compartments learn to raise circularity."""
    del version
    context.with_resource(code_allowed(allow_code))


NetworkName = Annotated[
    str, typer.Argument(metavar="NETWORK", help="Name in the catalogue, or a file: FILE.toml, FILE.toml:REGION.")
]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="Directory of a training run.")]
Scenario = Annotated[str | None, typer.Option(help="Scenario of the definition; default: the physical one.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of every random stream.")]
EpisodeSeed = Annotated[
    int | None,
    typer.Option(
        "--seed", min=0, help="Start as the first episode of this evaluation; default: the middle of all ranges."
    ),
]
EpisodeCount = Annotated[int, typer.Option(min=2, help="Fresh episodes to evaluate on.")]
EpisodesOfRun = Annotated[
    int | None, typer.Option(min=2, help="Fresh episodes; default: 64, or of a disturbed network 256 to 1024.")
]
CheckpointEvery = Annotated[
    float | None, typer.Option(min=0, help="Seconds between checkpoints; 0: none by time.", show_default="60")
]
Uncertain = Annotated[
    bool | None,
    typer.Option("--uncertain/--certain", help="Whether every episode draws the uncertain numbers of the network."),
]
MinService = Annotated[
    float | None,
    typer.Option(min=0.0, max=1.0, help="Mean level of each service that plans are for; default: all there is."),
]
AtMost = Annotated[
    list[str] | None,
    typer.Option("--at-most", help="ACCOUNT=TOTAL or ACCOUNT/year=MOST, a budget that plans keep; repeatable."),
]

Html = Annotated[
    Path | None,
    typer.Option("--html", help="Report for the browser to write as well: one .html file, which needs no server."),
]


def values_by_name(entries: Sequence[str] | None, option: str, form: str, read: Callable[[str], T]) -> dict[str, T]:
    """Read NAME=VALUE of each entry of a repeatable option; ``read`` raises a ``ValueError`` for what is no value.

    Raises:
        CirlError: naming the option, the entry, and the ``form`` that it needs.
    """
    values: dict[str, T] = {}
    for entry in entries or ():
        name, equals, text = (part.strip() for part in entry.partition("="))
        if name in values:
            raise CirlError(f"{option} {entry}: '{name}' is given twice")
        try:
            values[name] = read(text)
        except ValueError:
            equals = ""
        if not name or not equals:
            raise CirlError(f"{option} {entry}: needs {form}")
    return values


def budgets(entries: Sequence[str] | None) -> dict[str, float]:
    """Return what ``--at-most`` asks for, by account."""
    return values_by_name(entries, "--at-most", "ACCOUNT=TOTAL with a number", float)


@contextmanager
def stoppable(place: str, printer: Console = console) -> Iterator[None]:
    """Say after Ctrl-C what is kept, and end with code 130; ``place`` says what of it is where."""
    try:
        yield
    except KeyboardInterrupt:
        message = f"\nstopped; {place}. The same command goes on."
        printer.print(message, soft_wrap=True, highlight=False, markup=False)
        raise typer.Exit(130) from None


def end_with(failures: Sequence[object]) -> None:
    """Say what failed, and end with code 1 if anything did."""
    for failure in failures:
        errors.print(f"failed: {failure}", soft_wrap=True, highlight=False, markup=False)
    if failures:
        raise typer.Exit(1)


def plain(error: BaseException) -> str:
    """Keep rich from reading brackets in a message as markup."""
    return str(error).replace("[", r"\[")


def comma_separated(text: str) -> list[str]:
    """Return what a comma-separated option names."""
    return [name.strip() for name in text.split(",") if name.strip()]


def say(line: str) -> None:
    """Print a line as it is, whatever its length."""
    console.print(line.replace("[", r"\["), soft_wrap=True, highlight=False)


def stem(network: Network, *more: str) -> str:
    """Return the stem of a file about a network, so that no scenario takes the place of another."""
    from cirl_marl.definitions.reader import DEFAULT

    scenario = [] if network.scenario_name == DEFAULT else [network.scenario_name]
    return "_".join([network.name, *scenario, *more])


def folder_for(path: Path, option: str) -> Path:
    """Return ``path``, which is or can become a folder; a ``CirlError`` names the option if it cannot be written to."""
    if path.exists() and not path.is_dir():
        raise CirlError(f"{option} {path}: is a file, not a folder")
    _check_writable(path / "file", f"{option} {path}")
    return path


def page_for(path: Path | None) -> Path | None:
    """Return where a report for the browser goes, if it is asked for; a ``CirlError`` says why it cannot go there."""
    return None if path is None else file_for(path, "--html", ".html")


def file_for(path: Path, option: str, suffix: str, beside: Sequence[str] = ()) -> Path:
    """Return where a file goes, and others ``beside`` it that have its stem and these suffixes.

    Raises:
        CirlError: naming the option, if it has another ``suffix`` or cannot go there.
    """
    if path.suffix != suffix:
        raise CirlError(f"{option} {path}: needs the name of {'an' if suffix == '.html' else 'a'} {suffix} file")
    for file in (path, *map(path.with_suffix, beside)):
        if file.is_dir():
            raise CirlError(f"{option} {path}: {'' if file is path else f'{file} '}is a folder, not a file")
    _check_writable(path, f"{option} {path}")
    return path


def browser_report(path: Path | None, result: Reportable) -> list[Path]:
    """Write a report for the browser, if it is asked for, and return the paths of what was written."""
    if path is None:
        return []
    from cirl_marl.report.presentation import write_report

    return [write_report(path, result)]


def _check_writable(path: Path, subject: str) -> None:
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not folder.is_dir():
        raise CirlError(f"{subject}: {folder} is a file, not a folder")
    if not os.access(folder, os.W_OK):
        raise CirlError(f"{subject}: nothing can be written in {folder}")


@contextmanager
def bar(task: str) -> Iterator[Callable[[float], None]]:
    """Progress bar; the yielded function takes the share that is done."""
    with shares() as progress:
        yield lambda share: progress(task, share)


@contextmanager
def shares() -> Iterator[Callable[[str, float], None]]:
    """Progress of several things; the yielded function takes what is being done and the share of all done.

    It is a bar with the time left, or without a terminal a line now and then.
    """
    if not console.is_terminal:
        yield _share_lines()
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("preparing", total=1.0)
        yield lambda activity, share: progress.update(task, description=activity, completed=share)


def state_lines(statuses: Sequence[JobStatus], before: dict[str, str]) -> None:
    """Say of each job that begins or ends that it does; ``before`` keeps what was said last."""
    for status in statuses:
        if before.setdefault(status.name, "waiting") != status.state:
            before[status.name] = status.state
            say(f"{status.state}: {status.name}")


def _share_lines() -> Callable[[str, float], None]:
    """Return what says, every LINE_SECONDS, what is being done, the share that is done, and how long the rest takes."""
    began = latest = clock.perf_counter()

    def update(activity: str, share: float) -> None:
        nonlocal latest
        now = clock.perf_counter()
        if now - latest >= LINE_SECONDS and 0 < share < 1:
            latest = now
            say(f"{activity}: {share:.0%} done, some {(now - began) * (1 / share - 1):,.0f} s left")

    return update


@contextmanager
def training_bar() -> Iterator[Any]:
    """Live line of a training: environment steps/s, λ̄ and service level of the last episode; else plain lines."""
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("training"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[speed]:,.0f} environment steps/s"),
        TextColumn("λ̄ {task.fields[circularity]}"),
        TextColumn("service {task.fields[service]}"),
        TimeRemainingColumn(),
    )
    live = console.is_terminal
    with Progress(*columns, console=console, disable=not live) as progress:
        task = progress.add_task("training", total=None, speed=0.0, circularity="…", service="…")
        last_update = clock.perf_counter()
        state: Any = None

        def show() -> None:
            done, speed = min(state.env_steps, state.total), state.env_steps / max(state.seconds, 1e-9)
            progress.update(task, completed=done, total=state.total, speed=speed)
            if not live:
                figures = f"λ {state.circularity:.4g}, service {state.service_level:.3f}"
                console.print(f"{done:,}/{state.total:,} steps, {speed:,.0f} environment steps/s, {figures}")

        def update(now: Any) -> None:
            nonlocal last_update, state
            state = now
            if now.episode:
                circularity, service = f"{now.circularity:.4g}", f"{now.service_level:.3f}"
                progress.update(task, circularity=circularity, service=service)
            if clock.perf_counter() - last_update > (0.2 if live else 10.0):
                last_update = clock.perf_counter()
                show()

        yield update
        if state is not None:
            show()
