"""What reproduces the results of the paper, all of it simulated."""
