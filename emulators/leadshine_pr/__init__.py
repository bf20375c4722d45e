"""A drive with a path table ("PR mode") like those of Leadshine and StepperOnline."""
