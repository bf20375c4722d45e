"""Whether the messages of a CAN bus are in time, by theory: values in, values out; no clock."""
