"""The network as its agents see it: observations, actions, rewards, starts; batched, for PettingZoo, for Gymnasium."""
