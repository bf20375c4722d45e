"""Drive firmware: profile generator, servo, and the axis that joins them to a plant."""
