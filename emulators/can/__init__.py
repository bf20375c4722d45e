"""CAN frames, controllers and their errors."""
