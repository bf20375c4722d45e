"""The CiA 402 modes of operation."""
