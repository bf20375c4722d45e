"""The conformance kit for drives: judges a CiA 402 drive, whatever its host.

The clauses speak to the drive through canopen's client, on an emulated bus or on a real one. They
use the results, the worker and the reports of the kit for adaptations. `kit` lists the clauses.
"""
