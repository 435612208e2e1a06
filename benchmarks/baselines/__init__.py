"""Baselines: general solvers of the same programs, and simulators of the same motion; the model needs none."""
