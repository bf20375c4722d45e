"""When a fault may fire: what rules of CAN buses and of serial lines have in common."""


def wrong_condition(
    probability: float, from_ns: int, until_ns: int | None, skip: int, limit: int | None
) -> str:
    """What is wrong with a rule's conditions of chance, time [ns] and number; empty: nothing."""
    if not 0.0 <= probability <= 1.0:
        return f"probability {probability} is not 0.0 to 1.0"
    if from_ns < 0 or (until_ns is not None and until_ns <= from_ns):
        return f"from_ns {from_ns} until_ns {until_ns} is no span of time"
    if skip < 0 or (limit is not None and limit < 1):
        return f"skip {skip} is below 0, or limit {limit} below 1"
    return ""
