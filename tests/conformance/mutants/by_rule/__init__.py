"""Mutants made by rule: every small change of the sources that a rule allows, sampled by seed.

Mutants written by hand show that a clause finds the mistake it was written for. These show which
mistakes no clause was written for.

python -m tests.conformance.mutants.by_rule [--seed N] [--count N] [--only TEXT]

`rules` makes the changes, `sources` samples them, `loading` puts one in place of the module,
`execution` measures which clauses execute a statement, `trial` runs these clauses on a mutant.
`equivalent.toml` has the survivors that were read, with the reason why no clause can find them.
"""
