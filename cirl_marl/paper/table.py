"""The paper's figures and ours side by side, a table for each environment."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np
from rich.table import Table

from cirl_marl.paper.published import PaperEnvironment, PublishedRun
from cirl_marl.paper.results import WINDOW, EvaluationFigures, Result

COLUMNS = ("algorithm", "run", "seeds", "r_s", "r_e", "ζ", "ψ", "s (%)", "final policy", "minutes", "CPU min", "remark")
NUMERIC = COLUMNS[3:11]
NOT_RUN = "not run"


def result_line(result: Result) -> str:
    """Say in one line what a row gave."""
    figures = f"r_s {number(result.start_return)}, r_e {number(result.end_return)}, ζ {number(result.gain)}"
    if result.evaluation is None:
        figures += f", {_broke(result)}"
    elif result.evaluation.success is not None:
        figures += f", s {result.evaluation.success:.1f} %"
    return f"{result.row}: {figures}, {result.seconds / 60:.1f} min"


def environment_table(environment: PaperEnvironment, results: Sequence[Result]) -> Table:
    """Return the table of one environment for the terminal."""
    table = Table(title=f"{environment.name}, {environment.steps:,} steps", caption=notes(environment, results))
    for column in COLUMNS:
        table.add_column(column, justify="right" if column in NUMERIC else "left")
    for row in table_rows(environment, results):
        table.add_row(*row, end_section=row[1] == "ours")
    return table


def table_rows(environment: PaperEnvironment, results: Iterable[Result]) -> list[tuple[str, ...]]:
    """Return the cells of one environment: for each algorithm the paper's row and ours, then the tuned rows."""
    our_results = [result for result in results if result.row.environment == environment.name]
    results_on_disk = {kind: [r for r in our_results if r.row.settings == kind] for kind in ("published", "tuned")}
    rows = []
    for name, references in environment.runs.items():
        row_of_table = [result for result in results_on_disk["published"] if result.row.algorithm == name]
        rows += [_paper_row(environment, name, references), _our_row(environment, name, "ours", row_of_table)]
    for name in dict.fromkeys(result.row.algorithm for result in results_on_disk["tuned"]) or ("",):
        row_of_table = [result for result in results_on_disk["tuned"] if result.row.algorithm == name]
        rows.append(_our_row(environment, name, "tuned", row_of_table))
    return rows


def number(value: float | None) -> str:
    """Write a figure with three or four digits.

    >>> number(-4.43e8), number(17.8), number(None)
    ('-4.43e8', '17.8', '')
    """
    if value is None:
        return ""
    mantissa, exponent = _scale(value)
    return f"{value:.4g}" if exponent == 0 else f"{mantissa:.2f}e{exponent}"


def over_seeds(values: Sequence[float]) -> str:
    """Write mean ± standard deviation; one value alone as it is.

    >>> over_seeds([-4.0e8, -5.0e8]), over_seeds([3.0])
    ('-4.50e8 ± 0.71e8', '3')
    """
    mean = float(np.mean(values))
    if len(values) == 1:
        return number(mean)
    deviation = float(np.std(values, ddof=1))
    exponent = _scale(mean)[1]
    if exponent:
        return f"{number(mean)} ± {deviation / 10.0**exponent:.2f}e{exponent}"
    return f"{mean:.4g} ± {number(deviation)}"


def above_optimum(environment: PaperEnvironment, value: float | None) -> bool:
    """Return whether a figure, as it is written, is above the optimum, which is a mean over the starts."""
    return bool(environment.optima) and value is not None and _text(value) > _text(environment.optima[0].value)


def _text(value: float) -> float:
    return float(number(value))


def _scale(value: float) -> tuple[float, int]:
    """Split large and tiny figures into mantissa and exponent; the exponent of others is 0."""
    if value == 0 or not math.isfinite(value) or 1e-3 <= abs(value) < 1e4:
        return value, 0
    mantissa, exponent = f"{value:.2e}".split("e")
    return float(mantissa), int(exponent)


def _paper_row(environment: PaperEnvironment, algorithm: str, run: PublishedRun) -> tuple[str, ...]:
    gain = None if run.start_return is None or run.end_return is None else run.end_return - run.start_return
    figures = (run.start_return, run.end_return, gain, None if gain is None else gain / environment.steps, run.success)
    minutes = "" if run.minutes is None else f"{run.minutes:.1f}"
    above = _above(environment, {"r_s": run.start_return, "r_e": run.end_return})
    remark = f"{above}: chance, or other starts" if above else ""
    return (algorithm, "paper", "", *map(number, figures), "", minutes, "", remark)


def _above(environment: PaperEnvironment, figures: Mapping[str, float | None]) -> str:
    match = [name for name, value in figures.items() if above_optimum(environment, value)]
    return f"{', '.join(match)} above the optimum" if match else ""


def _our_row(environment: PaperEnvironment, algorithm: str, run: str, outcome: Sequence[Result]) -> tuple[str, ...]:
    """Average the seeds that have as many steps as the paper; failing these, those with the most steps."""
    if not outcome:
        return (algorithm, run, *("" for _ in NUMERIC), "", NOT_RUN)
    done = [result.row.steps for result in outcome]
    steps = environment.steps if environment.steps in done else max(done)
    seeds = sorted((result for result in outcome if result.row.steps == steps), key=lambda result: result.row.seed)

    def cell(figure: Callable[[Result], float]) -> str:
        return over_seeds([figure(result) for result in seeds])

    episodes = [result.evaluation for result in seeds if result.evaluation is not None]
    successes = [evaluation.success for evaluation in episodes if evaluation.success is not None]
    cpu = [result.cpu_seconds for result in seeds if result.cpu_seconds is not None]
    return (
        algorithm,
        run,
        ", ".join(str(result.row.seed) for result in seeds),
        cell(lambda result: result.start_return),
        cell(lambda result: result.end_return),
        cell(lambda result: result.gain),
        cell(lambda result: result.gain_per_step),
        over_seeds(successes) if successes else "",
        over_seeds([evaluation.mean for evaluation in episodes]) if episodes else "",
        f"{np.mean([result.seconds for result in seeds]) / 60:.1f}",
        f"{np.mean(cpu) / 60:.1f}" if cpu else "",
        "; ".join(_remarks(environment, seeds)),
    )


def _remarks(environment: PaperEnvironment, seeds: Sequence[Result]) -> Iterator[str]:
    """Say what sets a row apart: fewer steps or episodes than the paper's, weights that broke, a start shown, luck."""
    result = seeds[0]
    count = min(seed.window for seed in seeds)
    if count < WINDOW:
        yield f"r_s and r_e over {count} episodes"
    if result.row.steps != environment.steps:
        more = f", {result.steps_done:,} done" if result.steps_done > result.row.steps else ""
        yield f"{result.row.steps:,} of {environment.steps:,} steps{more}"
    for seed in seeds:
        if seed.has_diverged:
            yield f"seed {seed.row.seed}: {_broke(seed)}, r_e is of the last episodes before"
    words = result.settings.get("recipe", {}).get("learner", {}).get("demonstrations")
    if words:
        yield f"the first {words['steps']:,} steps, and r_s with them, are shown by {words['controller']} control"
    episodes = [seed.evaluation.mean for seed in seeds if seed.evaluation is not None]
    figures = {"r_s": [seed.start_return for seed in seeds], "r_e": [seed.end_return for seed in seeds]}
    means = {name: float(np.mean(values)) for name, values in (figures | {"final policy": episodes}).items() if values}
    if above := _above(environment, means):
        yield f"{above}: chance"


def _broke(result: Result) -> str:
    return f"weights NaN after {result.steps_done:,} of {result.row.steps:,} steps"


def notes(environment: PaperEnvironment, results: Iterable[Result]) -> str:
    """Say what final policies played and how much episodes vary, what is the best possible, and what differs."""
    best = "; ".join(f"{number(optimum.value)} ({optimum.how})" for optimum in environment.optima) or "not known"
    our_results = [result for result in results if result.row.environment == environment.name]
    recipes = [result for result in our_results if result.row.settings == "tuned"]
    sentences = []
    if episodes := distinct(result.evaluation.episodes for result in our_results if result.evaluation is not None):
        spread = [result.evaluation for result in recipes if result.evaluation is not None]
        deviation = f"; {_spread(spread)}" if spread else ""
        sentences.append(f"Final policy: {' or '.join(episodes)} episodes a seed{deviation}.")
    endings = [result.published_ends.mean for result in recipes if result.published_ends is not None]
    if endings:
        sentences.append(f"Tuned ones where episodes end as the published class ends them: {over_seeds(endings)}.")
    return " ".join([*sentences, f"Optimum: {best}.", environment.remark]).rstrip()


def _spread(evaluations: Sequence[EvaluationFigures]) -> str:
    deviation = float(np.mean([evaluation.deviation for evaluation in evaluations]))
    if deviation < 1e-9 * max(abs(evaluation.mean) for evaluation in evaluations):
        return "they are all alike, as the start is fixed"
    return f"those of tuned ones vary by sd {number(deviation)} an episode"


def distinct(values: Iterable[object]) -> list[str]:
    """Return what there is among ``values``, in order."""
    return sorted({str(value) for value in values})
