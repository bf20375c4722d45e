"""Clauses that kill no mutant which no other clause kills, and why they stay all the same."""

WHY_IT_STAYS: dict[str, str] = {
    "LOST-02": "a cable and a host are lost apart, by one dead-man here; elsewhere by two",
    "LOST-03": "likewise, and a host that lives is told by another state of the drive",
    "LOST-06": "a drive that falls to PRE-OPERATIONAL is safe from late commands; others are not",
}
