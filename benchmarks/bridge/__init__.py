"""Time until the coils are at zero, whatever process fails; and hostile messages to the coil bridge."""
