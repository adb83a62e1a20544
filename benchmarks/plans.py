"""Bounds and plans of real cycles at full service, as tables of ``docs/cycles.md``.

python -m benchmarks.plans    # of the world's copper, aluminium and plastics (some minutes)
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from benchmarks.document import write_sections
from cirl_marl import CirlError, MultiAgentVectorEnv, Network, load_network
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import episode_start
from cirl_marl.optimum import bound, gap, improve_plan, simulate_plan

DOCUMENT = Path(__file__).parent.parent / "docs" / "cycles.md"
CYCLES = ("copper_world", "aluminium_world", "plastics_world")


def plan_lines(what: str, networks: Mapping[str, Network], *, unit: float = 1.0) -> Iterator[str]:
    """Yield a table with a row for each network; ``unit`` is a megatonne in its unit of mass."""
    yield f"| {what} | as usual, Mt | bound, Mt | plan, Mt | gap | bound, s | plan, s |"
    yield "|-|-|-|-|-|-|-|"
    for name, network in networks.items():
        begun = episode_start(MultiAgentVectorEnv(network, num_envs=1))
        usual = begun.play(MultiAgentVectorEnv(network, num_envs=1), Neutral())
        usual_said = f"{usual.episode_circularity[0] / unit:.2f}"
        begin = time.process_time()
        try:
            found = bound(network, min_service=1.0)
        except CirlError as error:
            yield f"| {name} | {usual_said} | {str(error).partition(': ')[2][:60]} | | | | |"
            continue
        solved = time.process_time()
        run = simulate_plan(improve_plan(found))
        done = time.process_time()
        off = float(gap(found.verify().bound, run.episode_circularity[0]))
        seconds = f"{solved - begin:.0f} | {done - begin:.0f}"
        least = "" if float(run.levels[0].mean(axis=1).min()) >= 1 - 1e-6 else " (service short)"
        said = f"{found.objective / unit:.2f} | {run.episode_circularity[0] / unit:.2f}{least} | {off:.2%}"
        yield f"| {name} | {usual_said} | {said} | {seconds} |"


def main() -> None:
    """Write the table of the world's cycles."""
    networks = {f"`{name}`": load_network(name) for name in CYCLES}
    networks |= {
        f"`{name}`, {scenario}": load_network(name, scenario=scenario)
        for name in CYCLES
        for scenario in ("high_circularity", "sufficiency")
    }
    write_sections(DOCUMENT, {"cycles": "\n".join(plan_lines("cycle", dict(sorted(networks.items()))))})


if __name__ == "__main__":
    main()
