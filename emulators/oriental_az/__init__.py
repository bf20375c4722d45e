"""A closed-loop stepper with absolute encoder and "direct data operation" (Oriental AZ)."""
