"""Findings of a campaign for people: sentences, summary on the terminal, page with pictures."""
