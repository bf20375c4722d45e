"""Start of Python programs by fork, from a process that has imported motorhil already."""
