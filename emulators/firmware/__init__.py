"""What runs inside a drive: profile generator, servo cascade and the axis that joins them to a plant."""
