"""Calibration: fits the thread's parameters to recorded runs, and reports which are identifiable."""
