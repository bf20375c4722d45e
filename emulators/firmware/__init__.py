"""What runs inside a drive: profile generator, servo, and the axis joining them to a plant."""
