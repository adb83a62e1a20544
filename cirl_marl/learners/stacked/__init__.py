"""Learners of one algorithm and shape that run as one: parameters, optimisers and batches on a leading axis.

The algorithm is Stable-Baselines3's, its PPO and A2C for continuous actions, and so are the models: a stack begins with
what they hold and puts back what was learnt. Noise and minibatches come from each learner's own random streams, so that
a rollout and its updates are those of ``learn()`` up to rounding (``tests/test_stacked.py``).
"""
