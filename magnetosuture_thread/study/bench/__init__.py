"""How fast the model is, beside other solvers of the same programs and other simulators of the same motion."""
