"""Physics of motor, gear, load and encoder. No firmware, no clock."""
