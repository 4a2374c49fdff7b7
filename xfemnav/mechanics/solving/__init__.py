"""From a problem to its solution, and what to think of it."""
