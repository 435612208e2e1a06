"""Study: reference trajectories, scores, tables and pictures."""
