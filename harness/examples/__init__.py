"""Example rigs and scripts; `motorhil new DIR` copies one of them."""
