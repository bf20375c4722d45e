"""Verdicts explained: observation of a run, causes of failures, and results as files."""
