"""Commands, a file for each; its own packages are imported when it runs, so that --help is quick."""
