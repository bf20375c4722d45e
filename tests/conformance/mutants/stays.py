"""Clauses that kill no mutant which no other clause kills, and why they stay all the same."""

WHY_IT_STAYS: dict[str, str] = {
    "SHARE-11": "it looks for what the others did not think of; harness.sharing's mutants prove it",
    "SYNC-05": "ours ask a drive something before they arm any, and so find out that it is gone",
    "LOST-02": "a cable and a host are lost apart, by one dead-man here; elsewhere by two",
    "LOST-03": "likewise, and a host that lives is told by another state of the drive",
    "LOST-10": "it looks at instants that the others do not choose",
    "LOST-06": "a drive that falls to PRE-OPERATIONAL is safe from late commands; others are not",
    "SET-01": "the paper's own example, word for word: who breaks it breaks something else, too",
}
