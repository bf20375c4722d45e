"""EDS files and stored parameters."""
