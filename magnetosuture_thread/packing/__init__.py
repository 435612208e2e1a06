"""Messages as CDR bytes, made at once from arrays: what the nodes publish and what offline bags get."""
