"""The mcap format: scanning with every checksum, salvage of intact data, and writing."""
