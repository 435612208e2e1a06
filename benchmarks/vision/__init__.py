"""Hold the tracker against rendered frames whose ground truth is known."""
