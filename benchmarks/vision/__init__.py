"""How the tracker fares on rendered frames of many kinds."""
