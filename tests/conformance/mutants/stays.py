"""Clauses that kill no mutant which no other clause kills, and why they stay all the same."""

WHY_IT_STAYS: dict[str, str] = {}
