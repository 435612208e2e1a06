"""Autonomous procedures: goals, paths of the needle's body, and their execution."""
