"""The simulated overhead camera."""
