"""The motion of a network, compiled for batches: rows, flow laws, batches of material, inner physics, solvers."""
