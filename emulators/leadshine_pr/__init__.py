"""A drive with a path table ("PR mode"), as Leadshine and StepperOnline have it."""
