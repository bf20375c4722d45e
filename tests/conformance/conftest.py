"""The outsider's own tests are run by test_outsider.py, with its package."""

collect_ignore = ["outsider"]
