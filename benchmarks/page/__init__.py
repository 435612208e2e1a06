"""Time from a key press in the browser to the velocity at the coil bridge, and the pictures that the page draws."""
