"""Adaptation for Oriental Motor AZ drives on Modbus."""
