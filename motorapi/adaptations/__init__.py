"""Adaptations of the motor interface to hardware, with their hardware classes."""
