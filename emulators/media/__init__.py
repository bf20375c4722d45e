"""Media that join controllers: sans-I/O cores with ports, driven by virtual time."""
