"""Attacks varied at random: damaged bags, against what is promised of them."""
