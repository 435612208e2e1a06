"""Settings, errors, files and the table of topics: what every other subpackage builds on."""
