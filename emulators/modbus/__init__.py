"""Modbus servers, written from the specification: PDUs, registers and framing."""
