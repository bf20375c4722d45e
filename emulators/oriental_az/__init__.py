"""A closed-loop stepper with an absolute encoder and "direct data operation", as Oriental's AZ."""
