"""Prediction and measurement of how exactly a group starts and ends together."""
