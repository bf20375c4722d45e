"""A recording as one page to look at: collected in one pass, reduced, packed, drawn by a browser.

    trace --collect--> findings --assemble--> sections --page--> one HTML file without any link

`can_bus`, `modbus_line` and `motion` take what their channels hold; `rig_facts` reads what the
attached rig tells of units and bit rates. Nothing is guessed: what a recording does not tell is
said to be missing on the page.
"""
