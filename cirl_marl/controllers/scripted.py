"""Scripts and rules: what an engineer would do, by what an agent sees or by stocks, and a controller of them."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.compartments.incinerator import Incinerator
from cirl_marl.controllers.basic import Arrays, Constant, Controller
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import ControlError
from cirl_marl.network import Floats
from cirl_marl.network.compartment_model import CompartmentModel
from cirl_marl.network.elements import ControlKind, FeedbackRule
from cirl_marl.network.processes import interval_of

ModelStates = dict[str, Floats]
"""Observed states of an agent's own model by name, shape (B,) each, in physical units."""

Script = Callable[[ModelStates, Any], Floats]
"""Physical inputs, shape (inputs, B), from what is seen and the agent's model, whose parameters the engineer knows."""

OPEN_FINGERS, SHUT_FINGERS = 1.0, -1.0
"""Input of the fingers."""
MOVE_M = 0.05
"""Displacement of the gripper that an input of 1 asks for."""
HOVER_M = 0.08
"""Height above an object at which the gripper arrives from afar, so that it does not push the object away."""
SLOPE, STRADDLE_M = 1.2, 0.012
"""Descent of the way to an object, and how far in y the gripper may be off while its open fingers straddle it."""
CARRY_M, PLACE_M, NEAR_M = 0.03, 0.02, 0.06
"""Heights above the target at which the object is carried and set down, and the distance at which that begins."""
HOLDING_M = 0.03
"""Opening of each finger below which the gripper holds something; an object of 5 cm leaves them at 0.025."""


def fetch(states: ModelStates, model: Any = None) -> Floats:
    """Return the inputs of the Fetch robot that reach, grasp, lift, carry and place, shape (4, B).

    A function of the observation alone. Away from the object the gripper is open and comes down to it on a slope, or at
    its height where the fingers, which open in y, pass on both sides of it; around the object they close; once they
    hold, it is lifted, carried and set down; at the target it is let go.
    """
    whats = ("grip", "object", "desired")
    grip, item, target = (np.stack([states[f"{part}_{axis}"] for axis in "xyz"]) for part in whats)
    away = grip - item
    aside = np.hypot(*away[:2])
    around = (aside < 0.02) & (np.abs(away[2]) < 0.02)
    holds = around & (0.5 * (states["finger_r"] + states["finger_l"]) < HOLDING_M)
    distance = np.hypot(*(target - item)[:2])
    is_placed = (distance < 0.03) & (item[2] < target[2] + 0.03)
    reach, carry = item.copy(), target.copy()
    reach[2] += np.where(np.abs(away[1]) < STRADDLE_M, 0.0, np.clip(SLOPE * (aside - 0.015), 0.0, HOVER_M))
    carry[2] += np.where(distance > NEAR_M, CARRY_M, PLACE_M)
    towards = np.where(holds, carry, np.where(around, item, reach))
    towards = np.where(is_placed, np.stack([grip[0], grip[1], target[2] + HOVER_M]), towards)
    move = np.clip(1.5 * (towards - grip) / MOVE_M, -1.0, 1.0)
    fingers = np.where(around & ~is_placed, SHUT_FINGERS, OPEN_FINGERS)
    return np.concatenate([move, fingers[None]])


def reacher(states: ModelStates, model: Any = None) -> Floats:
    """Return the torques of the Reacher that move its tip to the target and let it rest, shape (2, B).

    Inverse kinematics give the joint angles, a damped spring the torques.
    """
    first = np.arctan2(states["sin_0"], states["cos_0"])
    second = np.arctan2(states["sin_1"], states["cos_1"])
    speed = np.stack([states["speed_0_rad_s"], states["speed_1_rad_s"]])
    angles = _joint_angles(states["target_x_m"], states["target_y_m"], second)
    turn = np.stack([angles[0] - first, angles[1] - second])
    turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
    return np.clip(STIFFNESS * turn - DAMPER * speed, -1.0, 1.0)


UPPER_M, LOWER_M = 0.1, 0.11
"""Lengths of the Reacher's arms, from its model file."""
ELBOW_RAD = 2.95
"""Most that the script bends the elbow; at the joint's end, 3.0, the torque would never fall to zero."""
STIFFNESS, DAMPER = 0.4, 0.05
"""Torque per rad and per rad/s. [chosen: fast and hardly overshooting]"""


def _joint_angles(x_m: Floats, y_m: Floats, second: Floats) -> tuple[Floats, Floats]:
    """Return the angles of both joints that put the tip at (x, y), the elbow bent to the side it already is."""
    distance2 = x_m**2 + y_m**2
    cosine = np.clip((distance2 - UPPER_M**2 - LOWER_M**2) / (2.0 * UPPER_M * LOWER_M), -1.0, 1.0)
    elbow = np.where(second >= 0.0, 1.0, -1.0) * np.minimum(np.arccos(cosine), ELBOW_RAD)
    shoulder = np.arctan2(y_m, x_m) - np.arctan2(LOWER_M * np.sin(elbow), UPPER_M + LOWER_M * np.cos(elbow))
    return shoulder, elbow


def truck(states: ModelStates, model: Any = None) -> Floats:
    """Return the force that drives a truck to its destination and stops it there, shape (1, B), N: a damped spring."""
    return SPRING_N_M * (states["destination_m"] - states["position_m"])[None] - BRAKE_N_S_M * states["speed_m_s"][None]


SPRING_N_M, BRAKE_N_S_M = 4e3, 6e3
"""[chosen: about critical for 3.2 t]"""


def incinerator(states: ModelStates, model: Incinerator) -> Floats:
    """Return the heat to take from the freeboard, shape (1, B), kJ/min: more where it is hotter than its set-point."""
    return HOLD_KJ_MIN + GAIN_KJ_MIN_K * (states["freeboard_degc"] - model.target_degc)[None]


HOLD_KJ_MIN, GAIN_KJ_MIN_K = 3.56e5, 3e4
"""Heat that holds 1000 °C at the reference inventory, and a gain that leaves it some degrees off elsewhere. [chosen]"""

SCRIPTS: dict[str, Script] = {"fetch": fetch, "reacher": reacher, "delivery_truck": truck, "incinerator": incinerator}
"""Script of each kind of model; that of a sorting station is its robot's."""


class FeedbackRules:
    """The rules of the agents of an environment, who know all stocks and the disturbances of the coming interval.

    Attributes:
        agents: those who have a rule.
    """

    def __init__(self, env: MultiAgentVectorEnv, without: Container[str] = (), *, margin: ArrayLike = 1.0) -> None:
        """Take the rules of all agents but some; what they aim at is multiplied by ``margin``.

        It may be one for each service, shape (services,); the largest counts for stocks that have set-points.
        """
        rules = {agent: env.network.compartments[agent].rule for agent in env.agents if agent not in without}
        margins = env.network.by_service("margin", margin, "a margin")
        self._env, self._largest_margin = env, float(np.max(margin))
        self._margins = dict(zip((s.id for s in env.network.services), margins.tolist(), strict=True))
        self._rules: dict[str, FeedbackRule] = {agent: rule for agent, rule in rules.items() if rule is not None}
        self.agents = tuple(self._rules)

    def actions(self, neutral: Arrays) -> dict[str, Floats]:
        """Return the actions of the agents in the coming interval, shape (B, 1) each; see ``FeedbackRule``.

        Those of all agents are ``neutral`` while no rule acts.
        """
        env = self._env
        state, lacks = env.physical, env.lacks()
        levels = {a: np.full_like(neutral[a], r.level) for a, r in self._rules.items() if r.level is not None}
        start = env.control_values({**neutral, **levels})
        values = dict(zip(env.network.processes.names, interval_of(state.disturbances, state.step), strict=True))
        actions = {}
        for agent, rule in self._rules.items():
            value = start[env.network.control_rows[agent].start]
            for name in rule.follows:
                value = value * values[name]
            factor = np.ones_like(value)
            for name, gain in zip(rule.watches, rule.gains, strict=True):
                factor += gain * (1.0 - (1.0 - lacks[name]) / self._margins.get(name, self._largest_margin))
            actions[agent] = env.normalise(agent, (value * factor)[None])
        return actions


class ScriptController(Controller):
    """Acts by the agent's rule, or the script for its kind of model; others, and those held constant, do not listen."""

    def __init__(self, constant: Mapping[str, float] | None = None, *, margin: ArrayLike = 1.0) -> None:
        """Hold the actions of some agents, agent → value in [−1, 1]; others without a script stay neutral.

        All that rules aim at is multiplied by ``margin``, or what each service aims at by its own, shape (services,).
        """
        self._constant, self._margin = Constant(constant), margin
        self._constant_agents = frozenset(constant or ())
        self._scripts: dict[str, tuple[Script, CompartmentModel, dict[str, int]]] = {}
        self._rules: FeedbackRules | None = None

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Find the script of each agent and what it reads; those held constant are refused as by ``Constant``."""
        self._constant.start(env, seed)
        self._scripts, self._env = {}, env
        self._rules = FeedbackRules(env, self._constant_agents, margin=self._margin)
        for agent in env.agents:
            compartment = env.network.compartments[agent]
            model, control = compartment.model, compartment.control
            if (
                model is None
                or agent in self._constant_agents
                or control is None
                or control.kind is not ControlKind.INPUT
            ):
                continue
            if script := SCRIPTS.get(model.robot.kind):
                places = {name: i for i, name in enumerate(env.layout.names[agent]) if name.startswith(f"{agent}.")}
                columns = {name.removeprefix(f"{agent}."): i for name, i in places.items()}
                self._scripts[agent] = script, model, columns

    @property
    def script_agents(self) -> tuple[str, ...]:
        """Agents for whom a script or a rule acts; none before ``start``."""
        return (*self._scripts, *(self._rules.agents if self._rules else ()))

    def act(self, observations: Arrays) -> Arrays:
        """Return each agent's action; a ``ControlError`` names a state that its script needs and it does not see."""
        actions = dict(self._constant.act(observations))
        if self._rules is not None and self._rules.agents:
            actions |= self._rules.actions(actions)
        for agent, (script, model, columns) in self._scripts.items():
            states = {name: observations[agent][:, i].astype(np.float64) for name, i in columns.items()}
            try:
                inputs = script(states, model)
            except KeyError as missing:
                raise ControlError(f"scripted control of '{agent}' needs to see its state {missing}") from None
            actions[agent] = self._env.normalise(agent, inputs)
        return actions
