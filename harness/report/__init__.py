"""Report of a recording as one HTML page.

The recording is read in one pass, reduced, packed, and drawn by the browser:

    trace --collect--> findings --assemble--> sections --page--> one HTML file without any link

`CanBus`, `ModbusLine` and `Motor` take the contents of their channels. `RigFacts` provides units
and bit rates from the attached rig. Nothing is guessed: the page states which data are missing in
the recording.
"""
