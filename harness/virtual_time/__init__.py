"""Virtual time: the runtime and unmodified programs in it."""
