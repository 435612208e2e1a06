"""The closed loop in one process on simulated time: many runs of a procedure, each by its seed."""
