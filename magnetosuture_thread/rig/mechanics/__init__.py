"""The rig's mechanics: the coils' field, needle and thread. Nothing here comes from the thread model."""
