"""Multi-agent reinforcement learning for the circular economy.

Compartments of a thermodynamical material network are agents, coupled by the mass they send each other; the team's
reward is the circularity λ(N;t) of the network.

>>> import cirl_marl
>>> cirl_marl.networks()[:3]
['carbo_net', 'copper_net', 'net_zero']
"""

from cirl_marl.definitions.catalogue import load_network, networks, recipes
from cirl_marl.environments.parallel import NetworkParallelEnv, aec_env, parallel_env, vector_env
from cirl_marl.environments.registration import register
from cirl_marl.environments.single import SingleAgentEnv, single_agent_env
from cirl_marl.environments.state import Snapshot
from cirl_marl.environments.vector import VectorEnv
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
    "VectorEnv",
    "aec_env",
    "load_network",
    "networks",
    "parallel_env",
    "recipes",
    "register",
    "single_agent_env",
    "vector_env",
]

register()
