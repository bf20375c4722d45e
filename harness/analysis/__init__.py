"""Schedulability analysis of CAN messages; pure functions without a clock."""
