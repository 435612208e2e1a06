"""Time of the thread model's steps and solves, beside other solvers of the same programs and other simulators."""
