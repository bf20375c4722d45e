"""Modbus client and polled motors that all Modbus adaptations share."""
