"""A drive that motorhil did not know: its adaptation, and an emulated one.

`host` is the motor interface's side, `emulated` is the drive's side of the bus. They share nothing,
not even a constant: a mistake in one of them then shows.
"""
