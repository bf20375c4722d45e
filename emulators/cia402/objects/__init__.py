"""The CiA 402 objects in the object dictionary."""
