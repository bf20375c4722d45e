"""Checked settings that several kinds of emulated drives share."""
