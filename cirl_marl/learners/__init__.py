"""Stable-Baselines3 learners, one per agent, learning together in one coupled environment."""
