"""The motor interface: what an application programs against."""
