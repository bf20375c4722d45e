"""One virtual clock for the programs of a rig, each in a process of its own."""
