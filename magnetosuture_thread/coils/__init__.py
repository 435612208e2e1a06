"""Coils: what a needle velocity command goes through on its way to the power stage."""
