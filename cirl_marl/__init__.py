"""Multi-agent reinforcement learning for the circular economy.

Compartments of a thermodynamical material network are agents, coupled by the mass they send each other; the team's
reward is the circularity λ(N;t) of the network.

>>> import cirl_marl
>>> cirl_marl.networks()[:3]
['aluminium_world', 'carbo_net', 'copper_net']
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cirl_marl.definitions.catalogue import load_network, networks, recipes
from cirl_marl.environments.parallel import NetworkParallelEnv, aec_env, parallel_env, vector_env
from cirl_marl.environments.registration import register
from cirl_marl.environments.single import SingleAgentEnv, single_agent_env
from cirl_marl.environments.state import Snapshot
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, ControlError, DefinitionError, LearnerError, NetworkError, RecipeError, RunError
from cirl_marl.network import Network
from cirl_marl.network.elements import (
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    Node,
    Objective,
    Observation,
    Role,
    Service,
)
from cirl_marl.network.series import Series

if TYPE_CHECKING:
    from cirl_marl.learners.teams.team import Team, independent
    from cirl_marl.reasons.explanation import explain
    from cirl_marl.reasons.inverse import infer

__version__ = "0.1.0"

__all__ = [
    "Arc",
    "CirlError",
    "Control",
    "ControlError",
    "ControlKind",
    "DefinitionError",
    "Episode",
    "Law",
    "LearnerError",
    "MultiAgentVectorEnv",
    "Network",
    "NetworkError",
    "NetworkParallelEnv",
    "Node",
    "Objective",
    "Observation",
    "RecipeError",
    "Role",
    "RunError",
    "Series",
    "Service",
    "SingleAgentEnv",
    "Snapshot",
    "Team",
    "aec_env",
    "explain",
    "independent",
    "infer",
    "load_network",
    "networks",
    "parallel_env",
    "recipes",
    "register",
    "single_agent_env",
    "vector_env",
]

register()


LATE = {
    "Team": "cirl_marl.learners.teams.team",
    "explain": "cirl_marl.reasons.explanation",
    "independent": "cirl_marl.learners.teams.team",
    "infer": "cirl_marl.reasons.inverse",
}
"""Where names are that are loaded when they are first asked for: what trains loads torch."""


def __getattr__(name: str) -> Any:
    """Return what is loaded late."""
    if name not in LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(LATE[name]), name)
