"""Operator page: web server, control lease and jog commands."""
