"""The rig's power stage: simulated RoboClaw boards behind pseudo-terminals. Nothing here knows the maker's library."""
