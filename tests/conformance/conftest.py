"""The outsider's own tests run in an environment with its package: see test_outsider.py."""

collect_ignore = ["outsider"]
