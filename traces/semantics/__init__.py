"""The meaning of a recording, and semantic comparison."""
