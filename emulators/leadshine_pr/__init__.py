"""A drive with a path table ("PR mode"), as by Leadshine."""
