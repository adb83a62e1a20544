"""Reasons: what things are worth, what agents look at, rules that act alike, and the aims behind a plan."""
