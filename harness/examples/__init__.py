"""Rigs and scripts to learn from; `motorhil new DIR` begins with one of them."""
