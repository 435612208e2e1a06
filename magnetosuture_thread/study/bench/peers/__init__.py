"""Peers: general solvers of the same programs, and simulators of the same motion; none is needed to run the model."""
