"""An emulated moteus controller: CAN FD, register subframes, trajectories on board."""
