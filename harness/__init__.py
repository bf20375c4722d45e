"""Rigs, virtual time, recorder and command line.

This is the only package that imports the motor interface, the emulators and the traces.
"""
