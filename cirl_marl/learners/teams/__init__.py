"""Independent Stable-Baselines3 learners in any PettingZoo environment."""
