"""``docs/paper_tables.md``: the paper's tables beside ours, in short and in full."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.document import markdown_table, wrapped
from benchmarks.paper_difference import ERRORS
from benchmarks.paper_summary import summary
from cirl_marl.paper.published import ENVIRONMENTS, HARDWARE, SOURCE
from cirl_marl.paper.results import WINDOW, Result
from cirl_marl.paper.table import COLUMNS, distinct, notes, table_rows

INTRODUCTION = f"""# The paper's tables, repeated

Published figures: {SOURCE}. `python benchmarks/paper.py --table` writes this page from `benchmarks/results/paper`.

- **paper**: what it reports, of one run. **ours**: the same with the library's default hyperparameters. **tuned**: our
  recipe `agents/paper_….toml`, with as many environment steps.
- r_s, r_e: mean return of the first and the last {WINDOW} training episodes, exploration included; ζ = r_e − r_s;
  ψ = ζ / steps. s: share of evaluation episodes with a success.
- final policy: mean return of the trained policy, deterministic, on fresh episodes.
- Several seeds: mean ± standard deviation. Figures above the optimum, a mean over all starts, are chance of the starts.
- difference: tuned less the paper's best, ± {ERRORS:g} standard errors. One run varies as seeds do, or as a mean of as
  many episodes, whichever is more; the paper's as ours do, or as its algorithm does here.
- Minutes: training alone, on busy machines; the paper's on a {HARDWARE}. CPU min: processor time, where recorded.
- Published CarboNet and CopperNet end their episodes otherwise
  ([networks.md](networks.md#the-published-carbonet-and-coppernet-where-episodes-start-and-end)): the best return
  there is −1.593e5 and −4.674e7, here −1.072e5 and −4.604e7 (`pytest tests/test_paper_optima.py`). There the
  difference is of the final policy in such episodes, elsewhere of r_e.
"""


def markdown(results: Sequence[Result], comment: str = "") -> str:
    """Return the document.

    Args:
        results: the rows that have been run.
        comment: what somebody has to say about them, in Markdown; it follows the table in short.
    """
    parts = [INTRODUCTION, "## In short\n\n" + summary(results) + "\n"]
    if comment:
        parts.append(comment.strip() + "\n")
    for environment in ENVIRONMENTS.values():
        title = f"## {environment.name} ({environment.steps:,} steps)"
        table = markdown_table(COLUMNS, table_rows(environment, results))
        parts.append(f"{title}\n\n{table}\n\n{notes(environment, results)}\n")
    parts.append(_provenance(results))
    return wrapped("\n".join(parts))


def _provenance(results: Sequence[Result]) -> str:
    """Name what our figures were made with; a version that changed between rows is listed with all its values."""
    if not results:
        return "## Made with\n\nNothing has been run yet.\n"
    names = list(dict.fromkeys(name for result in results for name in result.versions))
    versions = ", ".join(
        f"{name} {' and '.join(distinct(r.versions[name] for r in results if name in r.versions))}" for name in names
    )
    cpus = ", ".join(distinct(result.machine["cpus"] for result in results))
    models = ", ".join(distinct(result.machine.get("model", "not recorded in early rows") for result in results))
    threads = ", ".join(distinct(result.machine["torch_threads"] for result in results))
    hours = sum(result.seconds for result in results) / 3600
    days = sorted(result.finished[:10] for result in results)
    return (
        f"## Made with\n\n{len(results)} rows, {hours:.1f} hours of training on {cpus} CPUs "
        f"({models}; {threads} torch thread each, no GPU), {days[0]} to {days[-1]}.\n\n{versions}.\n"
    )
