"""Recordings of motorhil runs, one MCAP file per run."""
