"""Calibration: the thread's parameters that recorded runs can tell, and which of them they cannot."""
