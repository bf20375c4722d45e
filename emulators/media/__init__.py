"""What controllers are joined by: media as sans-I/O cores with ports, told the time."""
