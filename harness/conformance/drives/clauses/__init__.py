"""The clauses for drives, one module for each topic."""
