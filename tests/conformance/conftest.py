"""The outsider's own tests run where its package is installed: see test_outsider.py."""

collect_ignore = ["outsider"]
