"""The clauses of the kit, one module for each topic.

Clauses are written for any motor. They know only `bench.facts` and the motor's model. A safety
property ("never") calls `reached` to show that its cause did happen.
"""
