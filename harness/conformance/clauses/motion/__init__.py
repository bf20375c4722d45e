"""Clauses on the motion of one motor: how it starts, follows, measures, keeps limits and stops."""
