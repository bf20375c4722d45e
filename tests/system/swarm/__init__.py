"""Planted defects, and what a swarm makes of them."""
