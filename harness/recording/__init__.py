"""Recording of live buses: taps read them, the pump orders and counts, a series of files keeps."""
