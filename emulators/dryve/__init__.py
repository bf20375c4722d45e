"""The igus dryve D1: CiA 402 behind a Modbus TCP gateway."""
