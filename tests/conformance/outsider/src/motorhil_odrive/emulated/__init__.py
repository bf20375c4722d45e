"""An ODrive that is not there: what it says, does, and lets happen to its motor."""
