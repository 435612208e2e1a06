"""The simulated hernia repair: a thread steered by hand around a ring, in the thread model alone."""
