"""Recording of live buses: taps, pump, and a series of files."""
