"""The conformance kit: whether an adaptation keeps every promise of the motor interface.

`kit` has all clauses; a `clause` is a promise and a plain function over a `bench`; `run` checks
clauses on benches. What a motor can do (`capability`) it claims itself, or its rig does for it
(`claims`, `facts`).
"""
