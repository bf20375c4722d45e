"""The recordings of motorhil: one MCAP file a run."""
