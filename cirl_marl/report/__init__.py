"""Results shown: tables, curves, fronts, and the pictures of a run."""
