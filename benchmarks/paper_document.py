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

Published figures: {SOURCE}. Written by `python benchmarks/paper.py --table`, from the rows in
`benchmarks/results/paper`.

- **paper**: what it reports. **ours**: the same run here, `A("MlpPolicy", gymnasium.make(id))` with the library's
  default hyperparameters (goal tasks: `MultiInputPolicy`, `HerReplayBuffer`). **tuned**: our recipe
  `agents/paper_….toml`, with as many environment steps.
- r_s, r_e: mean return of the first and the last {WINDOW} training episodes, at most half of them each,
  exploration included; ζ = r_e − r_s; ψ = ζ / steps.
- s: share of evaluation episodes with a success at any step, deterministic policy.
- final policy: mean return of the trained policy, deterministic, on fresh episodes that no training saw.
- Several seeds: mean ± standard deviation over them. Where starts are drawn, a mean over n episodes varies by the
  standard deviation of one episode, which the notes give, over √n. Figures above the optimum, which is a mean over all
  starts, are such chance, and are marked.
- difference: tuned less the paper's best, ± its error, which is {ERRORS:g} standard errors. better: "yes" or "no" where
  the difference exceeds its error.
- standard error: one run varies by the standard deviation over seeds or by that of one episode over √n, whichever is
  more, and a mean over k runs by 1/√k of that. The paper's figure is of one run. It is taken to vary as ours do, or as
  its algorithm does over seeds here, whichever is more.
- Minutes: training alone, on the machines named below, which did other work at the same time; the paper's on a
  {HARDWARE}. CPU min: processor time, which other work does not lengthen; blank where it was not recorded, and over
  the seeds that have it. Speed on an idle machine: [benchmarks](../benchmarks/README.md).
- Time limits are truncations here. The published CarboNet and CopperNet end their episodes otherwise
  ([networks.md](networks.md#the-published-carbonet-and-coppernet-where-episodes-start-and-end)): the best return
  there is −1.593e5 and −4.674e7, here −1.072e5 and −4.604e7 (`pytest tests/test_paper_optima.py`). So the difference
  is there that of the final policy, in episodes that end as the published ones, to the paper's r_e. Elsewhere: of r_e.
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
