"""The conformance kit: checks an adaptation against the motor interface.

`kit` lists all clauses. A `clause` is a promise with a plain function that checks it on a `bench`.
`run` checks clauses on `benches`. A motor claims its capabilities itself, or its rig claims them.
`supervisor` has clauses checked in a `worker` process; `verdicts` explains the failures.
"""
