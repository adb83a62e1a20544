"""Multi-agent reinforcement learning for the circular economy.

Compartments of a thermodynamical material network are agents, coupled by the mass they send each other; the team's
reward is the circularity λ(N;t) of the network.

>>> import cirl_marl
>>> cirl_marl.networks()[:3]
['aluminium_world', 'car_batteries', 'carbo_net']

Every name here is loaded when it is first asked for (PEP 562), so that importing the library is cheap.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from cirl_marl.environments.registration import register as register

if TYPE_CHECKING:
    from cirl_marl.adapters.differentiable import DifferentiableEnv as DifferentiableEnv
    from cirl_marl.controllers.basic import Constant as Constant
    from cirl_marl.controllers.basic import Controller as Controller
    from cirl_marl.controllers.basic import Neutral as Neutral
    from cirl_marl.controllers.basic import Random as Random
    from cirl_marl.controllers.indicators import Indicators as Indicators
    from cirl_marl.controllers.indicators import indicators as indicators
    from cirl_marl.controllers.lqr import LQR as LQR
    from cirl_marl.controllers.rollout import Rollout as Rollout
    from cirl_marl.controllers.rollout import interval_ends as interval_ends
    from cirl_marl.controllers.rollout import rollout as rollout
    from cirl_marl.controllers.schedule import Schedule as Schedule
    from cirl_marl.controllers.scripted import ScriptController as ScriptController
    from cirl_marl.definitions.catalogue import load_network as load_network
    from cirl_marl.definitions.catalogue import networks as networks
    from cirl_marl.definitions.catalogue import recipes as recipes
    from cirl_marl.definitions.reader import write_network as write_network
    from cirl_marl.environments.derivatives import gradient as gradient
    from cirl_marl.environments.goal import GoalEnv as GoalEnv
    from cirl_marl.environments.joint import JointEnv as JointEnv
    from cirl_marl.environments.joint import JointVectorEnv as JointVectorEnv
    from cirl_marl.environments.multi_objective import MOParallelEnv as MOParallelEnv
    from cirl_marl.environments.multi_objective import mo_parallel_env as mo_parallel_env
    from cirl_marl.environments.parallel import NetworkParallelEnv as NetworkParallelEnv
    from cirl_marl.environments.parallel import aec_env as aec_env
    from cirl_marl.environments.parallel import parallel_env as parallel_env
    from cirl_marl.environments.parallel import vector_env as vector_env
    from cirl_marl.environments.single import SingleAgentEnv as SingleAgentEnv
    from cirl_marl.environments.single import single_agent_env as single_agent_env
    from cirl_marl.environments.state import Snapshot as Snapshot
    from cirl_marl.environments.vector import MultiAgentVectorEnv as MultiAgentVectorEnv
    from cirl_marl.errors import CirlError as CirlError
    from cirl_marl.errors import ControlError as ControlError
    from cirl_marl.errors import DefinitionError as DefinitionError
    from cirl_marl.errors import LearnerError as LearnerError
    from cirl_marl.errors import NetworkError as NetworkError
    from cirl_marl.errors import RecipeError as RecipeError
    from cirl_marl.errors import RunError as RunError
    from cirl_marl.evaluation.account_front import AccountFront as AccountFront
    from cirl_marl.evaluation.account_front import account_front as account_front
    from cirl_marl.evaluation.assessment import Evaluation as Evaluation
    from cirl_marl.evaluation.assessment import evaluate as evaluate
    from cirl_marl.evaluation.comparison import Comparison as Comparison
    from cirl_marl.evaluation.comparison import compare as compare
    from cirl_marl.evaluation.levers import Levers as Levers
    from cirl_marl.evaluation.levers import levers as levers
    from cirl_marl.evaluation.pareto import ParetoFront as ParetoFront
    from cirl_marl.evaluation.pareto import pareto_front as pareto_front
    from cirl_marl.evaluation.plans import plan as plan
    from cirl_marl.evaluation.simulations import Simulation as Simulation
    from cirl_marl.evaluation.simulations import simulate as simulate
    from cirl_marl.evaluation.simulations import simulate_alternatives as simulate_alternatives
    from cirl_marl.importing.assembly import import_flows as import_flows
    from cirl_marl.importing.disturbance_fits import fit_disturbances as fit_disturbances
    from cirl_marl.learners.interface import Trained as Trained
    from cirl_marl.learners.interface import export as export
    from cirl_marl.learners.interface import resume as resume
    from cirl_marl.learners.interface import train as train
    from cirl_marl.learners.recipe import Recipe as Recipe
    from cirl_marl.learners.recipe import load_recipe as load_recipe
    from cirl_marl.learners.teams.team import Team as Team
    from cirl_marl.learners.teams.team import independent as independent
    from cirl_marl.learners.trainer import Training as Training
    from cirl_marl.network.elements import Account as Account
    from cirl_marl.network.elements import Arc as Arc
    from cirl_marl.network.elements import Control as Control
    from cirl_marl.network.elements import ControlKind as ControlKind
    from cirl_marl.network.elements import Episode as Episode
    from cirl_marl.network.elements import Law as Law
    from cirl_marl.network.elements import Node as Node
    from cirl_marl.network.elements import Objective as Objective
    from cirl_marl.network.elements import Observation as Observation
    from cirl_marl.network.elements import Role as Role
    from cirl_marl.network.elements import Service as Service
    from cirl_marl.network.elements import Substance as Substance
    from cirl_marl.network.network import Network as Network
    from cirl_marl.network.piecewise import PiecewiseRate as PiecewiseRate
    from cirl_marl.network.series import Series as Series
    from cirl_marl.optimum.admissible import NoCertificate as NoCertificate
    from cirl_marl.optimum.bounds import Bound as Bound
    from cirl_marl.optimum.bounds import bound as bound
    from cirl_marl.optimum.bounds import envelope as envelope
    from cirl_marl.optimum.bounds import gap as gap
    from cirl_marl.optimum.cross_entropy import search as search
    from cirl_marl.optimum.improve import improve_plan as improve_plan
    from cirl_marl.optimum.mpc import MPC as MPC
    from cirl_marl.optimum.planned_episodes import Plan as Plan
    from cirl_marl.optimum.planned_episodes import simulate_plan as simulate_plan
    from cirl_marl.optimum.schedule_ascent import improve_schedule as improve_schedule
    from cirl_marl.optimum.smooth import smooth_plan as smooth_plan
    from cirl_marl.reasons.explanation import explain as explain
    from cirl_marl.reasons.inverse import infer as infer
    from cirl_marl.report.data_package import EpisodePackage as EpisodePackage
    from cirl_marl.report.data_package import read_package as read_package
    from cirl_marl.report.data_package import write_package as write_package
    from cirl_marl.report.iamc import YearlyValues as YearlyValues
    from cirl_marl.report.iamc import read_iamc as read_iamc
    from cirl_marl.report.iamc import write_iamc as write_iamc
    from cirl_marl.report.presentation import draw as draw
    from cirl_marl.report.presentation import summarise as summarise
    from cirl_marl.report.presentation import write_report as write_report
    from cirl_marl.suite.result_rows import pretrained as pretrained
    from cirl_marl.suite.row_jobs import benchmark as benchmark
    from cirl_marl.suite.tasks import BenchmarkTask as BenchmarkTask
    from cirl_marl.suite.tasks import load_task as load_task
    from cirl_marl.suite.tasks import tasks as tasks
    from cirl_marl.sweeps.running import sweep as sweep
    from cirl_marl.testing.conformance import check_parallel_env as check_parallel_env
    from cirl_marl.testing.conformance import check_vector_env as check_vector_env
    from cirl_marl.testing.nested import ConformanceError as ConformanceError

__version__ = "0.1.0"

_MODULES = {
    "adapters.differentiable": "DifferentiableEnv",
    "controllers.basic": "Constant Controller Neutral Random",
    "controllers.indicators": "Indicators indicators",
    "controllers.lqr": "LQR",
    "controllers.rollout": "Rollout interval_ends rollout",
    "controllers.schedule": "Schedule",
    "controllers.scripted": "ScriptController",
    "definitions.catalogue": "load_network networks recipes",
    "definitions.reader": "write_network",
    "environments.derivatives": "gradient",
    "environments.goal": "GoalEnv",
    "environments.joint": "JointEnv JointVectorEnv",
    "environments.multi_objective": "MOParallelEnv mo_parallel_env",
    "environments.parallel": "NetworkParallelEnv aec_env parallel_env vector_env",
    "environments.registration": "register",
    "environments.single": "SingleAgentEnv single_agent_env",
    "environments.state": "Snapshot",
    "environments.vector": "MultiAgentVectorEnv",
    "errors": "CirlError ControlError DefinitionError LearnerError NetworkError RecipeError RunError",
    "evaluation.assessment": "Evaluation evaluate",
    "evaluation.comparison": "Comparison compare",
    "evaluation.levers": "Levers levers",
    "evaluation.account_front": "AccountFront account_front",
    "evaluation.pareto": "ParetoFront pareto_front",
    "evaluation.plans": "plan",
    "evaluation.simulations": "Simulation simulate simulate_alternatives",
    "importing.assembly": "import_flows",
    "importing.disturbance_fits": "fit_disturbances",
    "learners.interface": "Trained export resume train",
    "learners.recipe": "Recipe load_recipe",
    "learners.teams.team": "Team independent",
    "learners.trainer": "Training",
    "network.elements": (
        "Account Arc Control ControlKind Episode Law Node Objective Observation Role Service Substance"
    ),
    "network.network": "Network",
    "network.piecewise": "PiecewiseRate",
    "network.series": "Series",
    "optimum.admissible": "NoCertificate",
    "optimum.bounds": "Bound bound envelope gap",
    "optimum.cross_entropy": "search",
    "optimum.improve": "improve_plan",
    "optimum.mpc": "MPC",
    "optimum.planned_episodes": "Plan simulate_plan",
    "optimum.schedule_ascent": "improve_schedule",
    "optimum.smooth": "smooth_plan",
    "reasons.explanation": "explain",
    "reasons.inverse": "infer",
    "report.data_package": "EpisodePackage read_package write_package",
    "report.iamc": "YearlyValues read_iamc write_iamc",
    "report.presentation": "draw summarise write_report",
    "suite.result_rows": "pretrained",
    "suite.row_jobs": "benchmark",
    "suite.tasks": "BenchmarkTask load_task tasks",
    "sweeps.running": "sweep",
    "testing.conformance": "check_parallel_env check_vector_env",
    "testing.nested": "ConformanceError",
}
"""Public names by the module that defines them; the imports above are the same for type checkers and editors."""

_HOMES = {name: f"{__name__}.{module}" for module, names in _MODULES.items() for name in names.split()}

__all__ = sorted(_HOMES)

register()


if not TYPE_CHECKING:  # else a misspelt name would be no mistake to a type checker

    def __getattr__(name: str) -> object:
        """Load the module that defines a public name, and keep the name."""
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return globals().setdefault(name, getattr(import_module(_HOMES[name]), name))


def __dir__() -> list[str]:
    """Return the public names."""
    return list(__all__)
