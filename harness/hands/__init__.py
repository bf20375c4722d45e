"""Hands on a running rig: the control of its time, stimuli and faults, from a page.

    elements   inputs and buses of a rig, as a page offers them
    requests   requests of a page, checked
    hands      the acts: when each takes effect, and its place in the record
    brake      the pace of the rig by the wall clock, at which requests are taken
    channel    requests and answers, as lines on two pipes

An act takes effect at an instant of the rig's time at which nothing else happens. So the rig file
can repeat it: see `motorhil.harness.rig.fragment`.
"""
