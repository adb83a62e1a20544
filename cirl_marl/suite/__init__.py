"""The frozen benchmark: tasks with proven bounds, rows of results with their weights, and how they are checked."""
