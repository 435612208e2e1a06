"""The mcap format: looked through with every checksum, read by an index of what is intact, and written."""
