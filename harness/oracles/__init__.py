"""Oracles: rules for any recording of drives on a bus, emulated or real."""
