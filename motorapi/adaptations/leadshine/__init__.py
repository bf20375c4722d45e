"""Adaptation for Leadshine PR drives on Modbus."""
