"""Writing, reading and recovering MCAP files."""
