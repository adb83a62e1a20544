"""A conformance suite for environments, and what it compares nested values with."""

from cirl_marl.testing.conformance import check_parallel_env, check_vector_env
from cirl_marl.testing.nested import ConformanceError

__all__ = ["ConformanceError", "check_parallel_env", "check_vector_env"]
