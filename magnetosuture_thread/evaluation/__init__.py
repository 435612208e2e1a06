"""Scores of predicted threads: on bags, in closed loops and on reference trajectories."""
