"""Clauses that kill no mutant which no other clause kills, and why they stay all the same."""

WHY_IT_STAYS: dict[str, str] = {
    "SHARE-11": "it looks for what the others did not think of; harness.sharing's mutants prove it",
    "SYNC-01": "it is Algorithm 2 itself; who begins apart is off the line of SYNC-08 as well",
    "SYNC-05": "ours ask a drive something before they arm any, and so find out that it is gone",
    "LOST-02": "a cable and a host are lost apart, by one dead-man here; elsewhere by two",
    "LOST-03": "likewise, and a host that lives is told by another state of the drive",
    "LOST-10": "it looks at instants that the others do not choose",
    "LOST-06": "a drive that falls to PRE-OPERATIONAL is safe from late commands; others are not",
    "SET-01": "the paper's own example, word for word: who breaks it breaks something else, too",
    "UNIT-01": "a wrong unit breaks all that moves; this one comes first, and names it",
    "ID-01": "a group is wrong, too, whose members move one another; this one names it",
    "START-03": "what is replaced late ends wrongly in longer sequences, too; this one is short",
    "HEAR-01": "LOST-09 loses one frame at a time, this one all there are for a while",
    "HEAR-02": "LOST-01 waits for a motion that is lost, this one operates a motor that stands",
    "HEAR-03": "LOST-04 and LOST-09 lose a motion, this one a motor that stands",
}
