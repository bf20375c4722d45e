"""Time, waiting and I/O sources of the application."""
