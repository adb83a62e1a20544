"""How good could it be? The bound, what its plan achieves, and how close model predictive control comes.

Ten days of the copper network; whole episodes take a minute.
"""

from rich import print

from cirl_marl import MPC, bound, envelope, gap, improve_plan, rollout, simulate_plan, vector_env

service, horizon = 0.98, 40

best = bound("copper_net", min_service=service, horizon=horizon)
proof = best.verify()  # from the multipliers alone, without the solver
plan = simulate_plan(improve_plan(best))  # in the simulator

env = vector_env("copper_net", num_envs=2, horizon=horizon)
env.reset(seed=0)
starts = env.physical.stock[env.rows.nodes].T
run = rollout(env, MPC(min_service=service, replan=8), seed=0)
proved = envelope("copper_net", starts, solves=2, min_service=run.episode_levels, horizon=horizon)
gaps = gap(proved.at(starts, run.episode_levels), run.episode_circularity)

summary = (
    f"no actions reach more than λ̄ = {proof.bound:.2f} kt with a service level of {service}; the plan reaches "
    f"{plan.episode_circularity[0]:.2f} kt, and MPC, from two other starts, is at most {gaps.max():.1%} from the bound"
)
print(summary)
