"""Suture thread prediction for the MagnetoSuture robot."""
