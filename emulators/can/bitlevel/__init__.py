"""CAN error signalling bit by bit."""
