"""Motion planning for one axis and for groups, from values alone."""
