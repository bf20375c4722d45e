"""Drive firmware: profile generator, servo and axis."""
