"""Conditions common to fault rules of CAN buses and of serial lines."""


def wrong_condition(
    probability: float, from_ns: int, until_ns: int | None, skip: int, limit: int | None
) -> str:
    """Return the error in the conditions of probability, time [ns] and number, or ""."""
    if not 0.0 <= probability <= 1.0:
        return f"probability {probability}: invalid; expected 0.0 to 1.0"
    if from_ns < 0 or (until_ns is not None and until_ns <= from_ns):
        return f"from_ns {from_ns} until_ns {until_ns}: invalid; expected 0 <= from_ns < until_ns"
    if skip < 0 or (limit is not None and limit < 1):
        return f"skip {skip} is below 0, or limit {limit} is below 1"
    return ""
