"""Adaptations of the motor interface to hardware, and the hardware classes they contain."""
