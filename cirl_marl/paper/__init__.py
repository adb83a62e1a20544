"""The tables of the CiRL paper: what it published, the same runs here, and both side by side."""
