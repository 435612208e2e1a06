"""Jobs: what each sub-command does, a file for each."""
