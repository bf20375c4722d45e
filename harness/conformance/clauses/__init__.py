"""The promises of the motor interface, a module for each topic; `harness.conformance.kit` has all.

Clauses are written for any motor: what they know of it are `bench.facts` and its model, and nothing
else. A safety property ("never") says with `reached` that its cause did happen.
"""
