"""What each sub-command of `magnetosuture` does, a file for each: its options, its work, and what it shows."""
