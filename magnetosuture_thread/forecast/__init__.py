"""Forecast: where needle and thread will be while a command is held."""
