"""What is no mistake in a network but seldom meant."""

from __future__ import annotations

from collections.abc import Iterator

from cirl_marl.network import Network


def remarks(network: Network) -> Iterator[str]:
    """Yield what whoever wrote ``network`` may not have meant.

    A shortfall of a service lowers the local reward of those who owe it. If none of them acts, or some do not, the
    agents are paid for stopping what the service is there to keep up.
    """
    if not network.agents:
        return
    for service in network.services:
        idle = [debtor for debtor in service.debtors if debtor not in network.agents]
        owed = "owed_by" if service.owed_by else "owed_by is left out, so the provider owes it;"
        if len(idle) == len(service.debtors):
            yield (
                f"service '{service.id}': {owed} {', '.join(idle)}: does not act, so that no agent is paid less when "
                f"the service fails; agents are {', '.join(network.agents)}"
            )
        elif idle:
            yield f"service '{service.id}': owed_by: {', '.join(idle)} does not act and cannot be paid less"
