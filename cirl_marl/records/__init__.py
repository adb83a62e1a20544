"""Files written whole or not at all, and what a result was made with: below everything that keeps results."""
