"""Modbus servers, written from the specification: what is asked, what is answered, on what line."""
