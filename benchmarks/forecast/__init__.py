"""Forecasts: how long they take, and how they compare with what then happened."""
